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
    """Starts without workers, with a short timeout."""
    monkeypatch.setattr(workers, "_workers", [])
    monkeypatch.setattr(workers, "LOOK_SECONDS", 0.02)


def test_results_come_in_order(fresh: None) -> None:
    def late(number: int) -> tuple[int, int]:
        time.sleep(0.01 * (number % 3))
        return number, threading.get_ident()

    found = list(in_order([partial(late, number) for number in range(20)], 3))
    assert [number for number, _ in found] == list(range(20)) and len({thread for _, thread in found}) == 3
    assert list(in_order([], 3)) == []


def test_an_error_is_raised_after_started_calls_end(fresh: None) -> None:
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


@pytest.mark.parametrize("refused", [True, False])
def test_unstarted_threads_raise_memory_error(fresh: None, monkeypatch: pytest.MonkeyPatch, refused: bool) -> None:
    """The system refuses threads, or starts threads that end at once for lack of memory."""
    start = _thread.start_new_thread

    def start_none(*_: object) -> int:
        if refused:
            raise RuntimeError("can't start new thread")
        return start(lambda: None, ())

    monkeypatch.setattr(_thread, "start_new_thread", start_none)
    said = "a thread cannot be started" if refused else "a thread was started and does not run"
    with pytest.raises(MemoryError, match=said):
        some(1)


def test_threads_that_end_early_are_replaced(fresh: None) -> None:
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


def test_a_finished_worker_holds_no_reference(fresh: None) -> None:
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
