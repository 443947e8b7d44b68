"""Ctrl-C during training: it ends training after the step under way, so that no step is applied in part."""

from __future__ import annotations

import signal
import threading
from types import FrameType

PRESSED = (signal.SIGINT, signal.SIGTERM)
# Of a closed terminal, and of schedulers before a job's time is over; the same one may arrive several times. Not all
# platforms have them.
WARNINGS = ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU")
ENDING = (*PRESSED, *(getattr(signal, name) for name in WARNINGS if hasattr(signal, name)))


class DeferredInterrupt:
    """Records signals of ENDING instead of raising KeyboardInterrupt; a second Ctrl-C or SIGTERM raises it at once.

    From ``begin`` to the end of the block, in the main thread, and in place of Python's own handler only.
    """

    def __init__(self) -> None:
        self.received = self._pressed = False
        self._replaced: list[signal.Signals] = []

    def begin(self) -> None:
        """Starts to record; further calls do nothing."""
        if self._replaced or threading.current_thread() is not threading.main_thread():
            return
        for number in ENDING:
            if signal.getsignal(number) is signal.default_int_handler:
                self._replaced.append(number)
                signal.signal(number, self._record)

    def __enter__(self) -> DeferredInterrupt:
        return self

    def __exit__(self, *_: object) -> None:
        for number in self._replaced:
            signal.signal(number, signal.default_int_handler)

    def _record(self, number: int, frame: FrameType | None) -> None:
        if self._pressed and number in PRESSED:
            signal.default_int_handler(number, frame)
        self.received, self._pressed = True, self._pressed or number in PRESSED
