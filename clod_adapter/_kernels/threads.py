"""Runs compiled kernels on several cores, from plain Python threads: another OpenMP runtime would
slow torch's down.
"""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from typing import Any

import torch

from clod_adapter._support.workers import shared, submit

_lock = threading.Lock()
_alone = 0  # contexts open now
_before = 0  # torch's threads before the first


def worker_count() -> int:
    """Number of workers: torch's number of threads (``torch.set_num_threads``,
    ``OMP_NUM_THREADS``).
    """
    return _before if _alone else torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """A context in which torch's operations use one thread, and kernels as many workers as before.

    Operations on about a hundred thousand numbers take less time than waking other threads.
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
    """Calls ``kernel(worker, workers, *arguments)`` for each worker and waits for all of them."""
    futures = list[Future[None]]()
    try:
        for worker in range(1, workers):
            futures.append(submit(shared(), kernel, worker, workers, *arguments))
        kernel(0, workers, *arguments)
    finally:
        wait(futures)  # also when interrupted: no thread may write into arrays that are returned
    for future in futures:
        future.result()
