"""Signals that end a run after the step under way, so that no step is applied in part."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from types import FrameType
from typing import Any

from clod_adapter.progress import Listener

PRESSED = (signal.SIGINT, signal.SIGTERM)
# Of a closed terminal, and of schedulers before a job's time is over; the same one may arrive several times. Not all
# platforms have them.
WARNINGS = ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU")
ENDING = (*PRESSED, *(getattr(signal, name) for name in WARNINGS if hasattr(signal, name)))


class GracefulStop:
    """Counts signals of ENDING. The first one requests a stop after the step under way.

    The second Ctrl-C or SIGTERM raises KeyboardInterrupt, unless a launcher repeats them (``aborts``).
    """

    def __init__(self, aborts: bool = True, presses: int = 0) -> None:
        self.requests, self.aborts, self.presses = 0, aborts, presses

    @property
    def aborted(self) -> bool:
        """Whether the user does not want anything to be written."""
        return self.aborts and self.presses > 1

    def heeding(self, display: Listener | None = None) -> Listener:
        """The listener that calls ``display`` and stops once a signal has arrived."""
        return lambda now: (display is None or display(now) is not False) and self.requests == 0

    def listening(self, in_place_of: Any = None) -> AbstractContextManager[None]:
        return handled_by(self._request, in_place_of)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requests += 1
        self.presses += number in PRESSED
        if self.aborted and number in PRESSED:
            raise KeyboardInterrupt


@contextmanager
def handled_by(handler: Callable[[int, FrameType | None], Any], in_place_of: Any = None) -> Iterator[None]:
    """Within the block ``handler`` has all signals that are not ignored, or those alone that another handler had."""
    if threading.current_thread() is not threading.main_thread():  # Python allows handlers only there
        yield
        return
    heard = [n for n in ENDING if n == signal.SIGTERM or signal.getsignal(n) is not signal.SIG_IGN]
    heard = [n for n in heard if in_place_of is None or signal.getsignal(n) is in_place_of]
    before = {number: signal.signal(number, handler) for number in heard}
    try:
        yield
    finally:
        for number, earlier in before.items():
            if signal.getsignal(number) is handler:  # not after all are ignored
                signal.signal(number, earlier)
