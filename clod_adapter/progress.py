"""Progress of long-running functions: what a listener is given, and how it, or a signal, stops
them.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from enum import Enum
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:  # the command reports an interrupt without importing torch
    from clod_adapter.gaussians import Gaussians

PRESSED = (signal.SIGINT, signal.SIGTERM)
# Signals of a closed terminal, and of schedulers before a job's time is over; the same one may
# arrive several times. Not all platforms have them.
WARNINGS = ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU")
ENDING = (*PRESSED, *(getattr(signal, name) for name in WARNINGS if hasattr(signal, name)))


class Phase(str, Enum):
    """The part of a computation that is under way; its value is the label that is displayed."""

    __str__ = str.__str__

    PHOTOGRAPHS = "photographs"
    CAMERAS = "placing cameras"
    PSEUDO_VIEWS = "pseudo views"
    SH_DEGREES = "SH degrees"
    IMPORTANCE = "importance"
    MERGING = "merging"
    PRUNING_ORDER = "pruning order"
    TRAINING = "training"
    FAR_REACH = "far reach"
    TUNING = "tuning"
    EVALUATION = "evaluation"
    FRAME_TIMES = "frame times"
    POPPING = "popping"


@dataclass(frozen=True)
class Progress:
    """The state of a phase; given to the listener after each of its steps.

    Attributes:
        done, total: steps of the phase: views, Gaussians (pruning order), candidates (cameras) or
            training steps.
        seconds: of training, 0 in other phases.
        time_share: the share of the time budget that is used; 0 without one.
        loss: running mean of the photometric loss at the smaller dial value of each view, NaN in
            other phases. In the first half of the steps that is above 1 in every second one.
        gaussians: in training, gives the result so far (while steps are averaged the mean). It
            shares memory with the parameters, so use it within the listener.
        state: in training, gives the ``TrainingState`` to resume from, likewise.
        error: why training ends here: a process was lost, or a step failed.
    """

    phase: Phase
    done: int
    total: int
    seconds: float = 0.0
    time_share: float = 0.0
    loss: float = math.nan
    gaussians: Callable[[], Gaussians] | None = None
    state: Callable[[], Any] | None = None
    error: str | None = None

    @property
    def share(self) -> float:
        """The share of the phase that is done, in [0, 1], by steps or by time budget, whichever is
        larger.
        """
        return max(self.done / self.total if self.total else 1.0, self.time_share)


Listener = Callable[[Progress], bool | None]
"""Returns False to stop; True or None to go on."""


class Stopped(Exception):
    """A listener returned False, and there is no partial result to return."""


def tell(listener: Listener | None, phase: Phase, done: int, total: int) -> None:
    """Calls the listener; raises Stopped if it returns False."""
    if listener is not None and listener(Progress(phase, done, total)) is False:
        raise Stopped(f"stopped at {phase} {done}/{total}")


@contextmanager
def progress_bar(progress: Listener | Literal[False] | None) -> Iterator[Listener | None]:
    """The listener ``progress``. For None a bar, where stderr is a terminal or a notebook's; for
    False none.
    """
    if progress is not None or not (sys.stderr.isatty() or "ipykernel" in sys.modules):
        yield progress or None
        return
    from tqdm import tqdm

    phase: Phase | None = None
    # not shown without a phase
    with tqdm(file=sys.stderr, leave=False, dynamic_ncols=True, delay=1e-9) as bar:

        def show(now: Progress) -> None:
            nonlocal phase
            bar.set_postfix_str(
                "" if math.isnan(now.loss) else f"loss {now.loss:.4f}", refresh=False
            )
            if phase != now.phase:
                phase = now.phase
                bar.set_description_str(now.phase, refresh=False)
                bar.miniters = 0  # what it has learned of faster steps would let it stand still
                bar.reset(now.total)
            bar.update(round(now.share * now.total) - bar.n)

        yield show


class GracefulStop:
    """Counts signals of ENDING. The first one requests a stop after the step under way.

    The second Ctrl-C or SIGTERM raises KeyboardInterrupt, unless a launcher repeats them
    (``aborts``).
    """

    def __init__(self, aborts: bool = True, presses: int = 0) -> None:
        self.requests = 0
        self.aborts = aborts
        self.presses = presses

    @property
    def aborted(self) -> bool:
        """Whether the user does not want anything to be written."""
        return self.aborts and self.presses > 1

    def stop_on_signal(self, display: Listener | None = None) -> Listener:
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
def handled_by(
    handler: Callable[[int, FrameType | None], Any], in_place_of: Any = None
) -> Iterator[None]:
    """Within the block ``handler`` has all signals that are not ignored, or those alone that
    another handler had.
    """
    # Python allows handlers only there
    if threading.current_thread() is not threading.main_thread():
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
