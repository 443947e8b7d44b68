"""Ctrl-C, and SIGTERM, with which schedulers announce the end, as another Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class GracefulStop:
    """Counts Ctrl-C. The first is a request, which the step under way outlives; a second one interrupts at once."""

    def __init__(self) -> None:
        self.requests = 0

    @contextmanager
    def listening(self) -> Iterator[None]:
        with _handled_by(self._request, signal.SIGINT, signal.SIGTERM):
            yield

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requests += 1
        if self.requests > 1:
            raise KeyboardInterrupt


@contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Within, SIGTERM raises KeyboardInterrupt. To be entered after pycolmap's import, which installs a handler."""
    with _handled_by(signal.default_int_handler, signal.SIGTERM):
        yield


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], Any], *numbers: signal.Signals) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # Python allows handlers only there
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
