"""Ctrl-C, and the signals of a closed terminal and of schedulers before they end a job; all are handled alike.

A signal that is ignored when the command starts stays ignored: shells start background jobs of a script without SIGINT,
as the Ctrl-C that ends the script is not meant for them, and nohup starts its command without SIGHUP. SIGTERM always
ends a job.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from clod_adapter.progress import Listener, Progress, Stopped
from clod_adapter.training.interrupts import ENDING, PRESSED


class GracefulStop:
    """Counts signals. The first one requests a stop after the step under way.

    The second Ctrl-C or SIGTERM raises KeyboardInterrupt. The other signals are repeated, and do not.

    Args:
        aborts: whether the second one does. Launchers repeat all signals, so their processes do not abort.
        presses: of Ctrl-C or SIGTERM before.
    """

    def __init__(self, aborts: bool = True, presses: int = 0) -> None:
        self.requests, self.aborts, self.presses = 0, aborts, presses

    @property
    def aborted(self) -> bool:
        """Whether the user does not want anything to be written."""
        return self.aborts and self.presses > 1

    def heeding(self, display: Listener | None = None) -> Listener:
        """The listener that calls ``display`` and stops once a signal has arrived."""

        def listen(now: Progress) -> bool:
            return (display is None or display(now) is not False) and self.requests == 0

        return listen

    @contextmanager
    def listening(self) -> Iterator[None]:
        with _handled_by(self._request):
            yield

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requests += 1
        self.presses += number in PRESSED
        if self.aborted and number in PRESSED:
            raise KeyboardInterrupt


@contextmanager
def interrupt_as_stopped() -> Iterator[None]:
    """Within the block Ctrl-C raises Stopped. From the dispatcher of a compiled function it comes as a SystemError."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise Stopped("interrupted") from error
    except SystemError as error:
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        raise Stopped("interrupted") from error


@contextmanager
def signals_as_interrupt() -> Iterator[None]:
    """Within the block all raise KeyboardInterrupt. Enter it after importing pycolmap, which sets a handler."""
    with _handled_by(signal.default_int_handler):
        yield


def listen_no_more() -> None:
    """Ignores all until the process ends, also after the blocks above."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], Any]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # Python allows handlers only there
        yield
        return
    heard = [n for n in ENDING if n == signal.SIGTERM or signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in heard}
    try:
        yield
    finally:
        for number, earlier in before.items():
            if signal.getsignal(number) is handler:  # not after listen_no_more
                signal.signal(number, earlier)
