from __future__ import annotations

import _thread
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch

from clod_adapter._kernels import threads
from clod_adapter._support import workers
from clod_adapter._support.workers import Worker, in_order, some


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """No workers yet, and little patience."""
    monkeypatch.setattr(workers, "_workers", [])
    monkeypatch.setattr(workers, "LOOK_SECONDS", 0.02)


def test_results_come_in_order(fresh: None) -> None:
    def late(number: int) -> tuple[int, int]:
        time.sleep(0.01 * (number % 3))
        return number, threading.get_ident()

    found = list(in_order([partial(late, number) for number in range(20)], 3))
    assert [number for number, _ in found] == list(range(20)) and len({thread for _, thread in found}) == 3
    assert list(in_order([], 3)) == []


def test_an_error_ends_it_once_all_that_was_begun_is_done(fresh: None) -> None:
    done, asked = [], []

    def call(number: int) -> None:
        if number == 1:
            raise ValueError("one")
        time.sleep(0.05)
        done.append(number)

    def calls() -> Any:
        for number in range(100):
            asked.append(number)
            yield partial(call, number)

    with pytest.raises(ValueError, match="one"):
        list(in_order(calls(), 2))
    assert sorted(done) == sorted(set(asked) - {1}) and len(asked) < 10


def test_threads_that_the_system_refuses(fresh: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(_thread, "start_new_thread", refuse)
    with pytest.raises(MemoryError, match="a thread cannot be started"):
        some(1)


def test_threads_that_die_before_they_run(fresh: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where there is no memory left for their stack: the system has started them, and they never say a word."""
    start = _thread.start_new_thread
    monkeypatch.setattr(_thread, "start_new_thread", lambda *_: start(lambda: None, ()))
    with pytest.raises(MemoryError, match="a thread was started and does not run"):
        some(1)


def test_threads_that_die_with_work_before_them(fresh: None) -> None:
    def kernel(worker: int, count: int, out: torch.Tensor) -> None:
        out[worker] = count

    out = torch.zeros(2)
    (worker,) = some(1)
    submit = worker.submit

    def die_first(call: Callable[[], Any]) -> Any:
        worker._jobs.put(partial(_thread.exit))  # type: ignore[arg-type]
        return submit(call)

    worker.submit = die_first  # type: ignore[method-assign]
    with pytest.raises(MemoryError, match="a thread ended before its work was done"):
        threads.run(kernel, 2, out)
    threads.run(kernel, 2, out)  # with another worker in its place
    assert out.tolist() == [2, 2]


def test_a_worker_holds_nothing_once_it_is_done(fresh: None) -> None:
    """An idle thread that held a tensor while the interpreter ends would abort the process."""

    class Held:
        gone = False

        def __call__(self) -> None:
            pass

        def __del__(self) -> None:
            Held.gone = True

    Worker().submit(Held()).result()
    until = time.monotonic() + 5
    while not Held.gone and time.monotonic() < until:
        time.sleep(0.01)
    assert Held.gone
