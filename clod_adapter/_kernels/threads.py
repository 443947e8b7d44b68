"""Runs compiled kernels on several cores from plain Python threads.

Kernels are compiled with ``nogil=True`` and take ``(worker, workers, *arguments)``. Python's own
threads avoid a second OpenMP runtime beside torch's, which would spin against it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch

from clod_adapter._support.workers import Job, some

_lock = threading.Lock()
_alone, _before = 0, 0  # how many want torch on one thread now, and how many threads it had


def worker_count() -> int:
    """As many workers as torch uses threads (``torch.set_num_threads``, ``OMP_NUM_THREADS``)."""
    return _before if _alone else torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Within, torch's own operations stay on one thread, while kernels use as many workers as before.

    For work on a hundred thousand numbers at a time, which costs less than waking other threads for it.
    """
    global _alone, _before
    with _lock:
        if _alone == 0:
            _before = torch.get_num_threads()
        _alone += 1
    try:
        torch.set_num_threads(1)
        yield
    finally:
        with _lock:
            _alone -= 1
            if _alone == 0:
                torch.set_num_threads(_before)


def run(kernel: Callable[..., Any], workers: int, *arguments: Any) -> None:
    """Calls ``kernel(worker, workers, *arguments)`` for each worker and waits for all of them.

    Raises:
        MemoryError: a thread cannot be started, or has died.
    """
    if workers == 1:
        kernel(0, 1, *arguments)
        return
    others: list[Job] = []
    try:
        for worker, thread in enumerate(some(workers - 1), start=1):
            others.append(thread.submit(partial(kernel, worker, workers, *arguments)))
        kernel(0, workers, *arguments)
    finally:
        for other in others:
            other.wait()  # also when interrupted: nobody may still write into arrays that are handed back
    for other in others:
        other.result()
