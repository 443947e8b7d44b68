"""Worker threads whose failure to start or to finish raises instead of blocking.

With little memory or a limit on threads, a thread may fail to start or end early. Python's ``Thread.start`` and
executors then wait forever.
"""

from __future__ import annotations

import _thread
import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from queue import SimpleQueue
from typing import Any, TypeVar

LOOK_SECONDS = 1.0  # between two checks that a thread is alive
LOOKS = 30  # checks of a starting thread; a single long wait would also count the time of a stopped process

Result = TypeVar("Result")


class Job:
    """A call on a worker thread; ``result`` waits for it."""

    def __init__(self, worker: Worker, call: Callable[[], Any]) -> None:
        self._worker, self._call = worker, call
        self._value: Any = None
        self._error: BaseException | None = None
        self._open = _thread.allocate_lock()
        self._open.acquire()

    def __call__(self) -> None:
        try:
            self._value = self._call()
        except BaseException as error:  # raised by ``result``
            self._error = error
        finally:
            del self._call
            self._open.release()

    def wait(self) -> None:
        """Waits for the call to end; raises MemoryError if the worker ended before."""
        while not self._open.acquire(timeout=LOOK_SECONDS):
            if not self._worker.alive:
                if not self._open.acquire(blocking=False):
                    raise MemoryError("a thread ended before its work was done")
                break
        self._open.release()

    def result(self) -> Any:
        """The return value of the call; raises its exception."""
        self.wait()
        if self._error is not None:
            raise self._error
        return self._value


class Worker:
    """A thread that runs jobs one after the other until the process ends.

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
                self._jobs.get()()  # unnamed, so that a finished job's arrays are freed
        finally:
            self._life.release()


_lock = threading.Lock()
_workers: list[Worker] = []


def some(count: int) -> Sequence[Worker]:
    """``count`` workers, shared by all callers.

    Raises:
        MemoryError: they cannot be started.
    """
    with _lock:
        _workers[:] = [worker for worker in _workers if worker.alive]
        while len(_workers) < count:
            _workers.append(Worker())
        return _workers[:count]


def _forget() -> None:
    """For a forked child, which has none of the threads."""
    global _lock
    _lock = threading.Lock()
    _workers.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def in_order(calls: Iterable[Callable[[], Result]], count: int) -> Generator[Result, None, None]:
    """Results of the calls, in order, run on ``count`` workers; at most ``2 count`` calls are in progress or waiting.

    If a call raises or the iterator is closed, started calls are waited for and no more are started.
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
