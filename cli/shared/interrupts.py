"""Ctrl-C, and SIGTERM, with which schedulers announce the end, as another Ctrl-C.

A SIGINT that is ignored when the command starts stays ignored: shells start a background job of a script so, and the
Ctrl-C that ends the script is not meant for the job. SIGTERM ends the job in any case.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class GracefulStop:
    """Counts Ctrl-C. The first is a request, which the step under way outlives; a second one interrupts at once.

    Args:
        aborts: whether it does. Launchers and schedulers repeat their signals: what they start does not abort.
    """

    def __init__(self, aborts: bool = True) -> None:
        self.requests, self.aborts = 0, aborts

    @property
    def aborted(self) -> bool:
        """Whether nothing is to be written any more."""
        return self.aborts and self.requests > 1

    @contextmanager
    def listening(self) -> Iterator[None]:
        with _handled_by(self._request, signal.SIGINT, signal.SIGTERM):
            yield

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requests += 1
        if self.aborted:
            raise KeyboardInterrupt


@contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Within, SIGTERM raises KeyboardInterrupt. To be entered after pycolmap's import, which installs a handler."""
    with _handled_by(signal.default_int_handler, signal.SIGTERM):
        yield


def listen_no_more() -> None:
    """From here to the end of the process, past the blocks above, neither Ctrl-C nor SIGTERM is heard."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], Any], *numbers: signal.Signals) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # Python allows handlers only there
        yield
        return
    heard = [n for n in numbers if n != signal.SIGINT or signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in heard}
    try:
        yield
    finally:
        for number, earlier in before.items():
            if signal.getsignal(number) is handler:  # and not listen_no_more
                signal.signal(number, earlier)
