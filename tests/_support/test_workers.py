"""Threads for kernels and files: order of results, errors, and threads that cannot be started."""

import threading
import time
from functools import partial

import pytest
import torch

from clod_adapter._kernels import threads
from clod_adapter._support.workers import in_order, shared


def test_results_come_in_order() -> None:
    def late(number: int) -> tuple[int, int]:
        time.sleep(0.01 * (number % 3))
        return number, threading.get_ident()

    found = list(in_order([partial(late, number) for number in range(20)], 3))
    assert [number for number, _ in found] == list(range(20)) and len({thread for _, thread in found}) == 3
    assert list(in_order([], 3)) == []


def test_an_error_is_raised_after_started_calls_end() -> None:
    done, asked = [], []

    def call(number: int) -> None:
        if number == 1:
            raise ValueError("one")
        time.sleep(0.05)
        done.append(number)

    with pytest.raises(ValueError, match="one"):
        list(in_order((asked.append(k) or partial(call, k) for k in range(100)), 2))
    assert set(done) <= set(asked) - {1} and len(asked) < 10
    count = len(done)
    time.sleep(0.1)
    assert len(done) == count


def test_kernels_run_again_after_threads_were_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def kernel(worker: int, count: int, out: torch.Tensor) -> None:
        out[worker] = count

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    shared.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        for run in (lambda: threads.run(kernel, 3, torch.zeros(3)), lambda: list(in_order([int], 2))):
            with pytest.raises(MemoryError, match="a thread cannot be started: too little memory"):
                run()
    threads.run(kernel, 3, out := torch.zeros(3))
    assert out.tolist() == [3, 3, 3]
