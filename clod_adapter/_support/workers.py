"""Threads that are waited for only as long as they live.

Where memory or the number of threads is limited, a thread may fail to start, or die of it before it has said so.
Python's own ``Thread.start`` and executors then wait for good, for a word that never comes.
"""

from __future__ import annotations

import _thread
import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from queue import SimpleQueue
from typing import Any, TypeVar

LOOK_SECONDS = 1.0  # between two looks at whether a thread that is waited for still lives
LOOKS = 30  # for the word of a thread that it runs; not one long wait, which a stopped process would spend stopped

Result = TypeVar("Result")


class Job:
    """A call that a worker makes; ``result`` waits for it."""

    def __init__(self, worker: Worker, call: Callable[[], Any]) -> None:
        self._worker, self._call = worker, call
        self._value: Any = None
        self._error: BaseException | None = None
        self._open = _thread.allocate_lock()
        self._open.acquire()

    def __call__(self) -> None:
        try:
            self._value = self._call()
        except BaseException as error:  # handed to who waits
            self._error = error
        finally:
            del self._call
            self._open.release()

    def wait(self) -> None:
        """Raises MemoryError where the worker has died with the call undone."""
        while not self._open.acquire(timeout=LOOK_SECONDS):
            if not self._worker.alive:
                if not self._open.acquire(blocking=False):
                    raise MemoryError("a thread ended before its work was done")
                break
        self._open.release()

    def result(self) -> Any:
        """What the call returns; raises what it raises."""
        self.wait()
        if self._error is not None:
            raise self._error
        return self._value


class Worker:
    """A thread that makes calls, one after the other, until the process ends.

    Raises:
        MemoryError: it cannot be started.
    """

    def __init__(self) -> None:
        self._jobs: SimpleQueue[Job] = SimpleQueue()
        self._started, self._life = threading.Event(), _thread.allocate_lock()
        self._life.acquire()
        try:
            _thread.start_new_thread(self._serve, ())
        except RuntimeError as error:
            raise MemoryError("a thread cannot be started: too little memory, or too many threads") from error
        if not any(self._started.wait(LOOK_SECONDS) for _ in range(LOOKS)):
            raise MemoryError("a thread was started and does not run")

    @property
    def alive(self) -> bool:
        return self._life.locked()

    def submit(self, call: Callable[[], Any]) -> Job:
        job = Job(self, call)
        self._jobs.put(job)
        return job

    def _serve(self) -> None:
        try:
            self._started.set()
            while True:
                self._jobs.get()()  # no name holds the job, and so its arrays, while the next one is waited for
        finally:
            self._life.release()


_lock = threading.Lock()
_workers: list[Worker] = []


def some(count: int) -> Sequence[Worker]:
    """As many workers, the same ones for all.

    Raises:
        MemoryError: they cannot be started.
    """
    with _lock:
        _workers[:] = [worker for worker in _workers if worker.alive]
        while len(_workers) < count:
            _workers.append(Worker())
        return _workers[:count]


def _forget() -> None:
    """In a forked child, which has none of the threads."""
    global _lock
    _lock = threading.Lock()
    _workers.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def in_order(calls: Iterable[Callable[[], Result]], count: int) -> Generator[Result, None, None]:
    """The results of the calls, in their order, made on ``count`` workers; at most twice as many are ahead.

    Where one raises, or the iterator is closed, those that were begun are waited for and no more are made.
    """
    workers, pending = some(count), deque[Job]()
    try:
        for number, call in enumerate(calls):
            pending.append(workers[number % count].submit(call))
            if len(pending) >= 2 * count:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        for job in pending:
            job.wait()
