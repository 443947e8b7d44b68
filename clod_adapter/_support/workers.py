"""Worker threads of ``concurrent.futures``; where a thread cannot be started, MemoryError is
raised.
"""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

MOST_THREADS = 256  # threads; they are started as they are needed

Result = TypeVar("Result")


@cache
def shared() -> ThreadPoolExecutor:
    """The threads that all kernels share; none of their calls waits for another."""
    return ThreadPoolExecutor(MOST_THREADS)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=shared.cache_clear)  # a forked child has none of the threads


def submit(
    pool: ThreadPoolExecutor, call: Callable[..., Result], *arguments: Any
) -> Future[Result]:
    """``pool.submit``. Where a thread cannot be started, the pool's calls that have not begun are
    dropped.
    """
    try:
        return pool.submit(call, *arguments)
    except RuntimeError as error:
        shared.cache_clear()
        pool.shutdown(cancel_futures=True)
        raise MemoryError(
            "a thread cannot be started: too little memory, or too many threads"
        ) from error


def in_order(calls: Iterable[Callable[[], Result]], count: int) -> Generator[Result, None, None]:
    """Results of the calls, in order, run on ``count`` threads; at most ``2 count`` calls are in
    progress or waiting.

    If a call raises or the iterator is closed, started calls are waited for and no more are
    started.
    """
    pool = ThreadPoolExecutor(count)
    pending = deque[Future[Result]]()
    try:
        for call in calls:
            pending.append(submit(pool, call))
            if len(pending) >= 2 * count:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
