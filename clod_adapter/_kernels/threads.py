"""Runs compiled kernels on several cores from plain Python threads.

Kernels are compiled with ``nogil=True`` and take ``(worker, workers, *arguments)``. Python's own
threads avoid a second OpenMP runtime beside torch's, which would spin against it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import torch


@lru_cache(maxsize=1)
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=workers, thread_name_prefix="clod-adapter")


if hasattr(os, "register_at_fork"):  # a forked child has the pool's bookkeeping, but not its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


_held: list[int] = []  # how many workers there are while torch is kept on one thread


def worker_count() -> int:
    """As many workers as torch uses threads (``torch.set_num_threads``, ``OMP_NUM_THREADS``)."""
    return _held[-1] if _held else torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Within, torch's own operations stay on one thread, while kernels use as many workers as before.

    For work on a hundred thousand numbers at a time, which costs less than waking other threads for it.
    """
    before = torch.get_num_threads()
    _held.append(worker_count())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _held.pop()


def run(kernel: Callable[..., Any], workers: int, *arguments: Any) -> None:
    """Calls ``kernel(worker, workers, *arguments)`` for each worker and waits for all of them."""
    if workers == 1:
        kernel(0, 1, *arguments)
        return
    others = [_pool(workers - 1).submit(kernel, worker, workers, *arguments) for worker in range(1, workers)]
    try:
        kernel(0, workers, *arguments)
    finally:
        wait(others)  # also when interrupted: nobody may still write into arrays that are handed back
    for other in others:
        other.result()
