"""Messages and progress, all on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any

from clod_adapter import Phase, Progress
from clod_adapter.io.settings import WARNING
from clod_adapter.progress import GracefulStop

if TYPE_CHECKING:
    from tqdm import tqdm

LINE_EVERY = 10.0  # seconds between progress lines if stderr is not a terminal
BAR_FORMAT = "{desc} {percentage:3.0f}%|{bar}| {remaining} left{postfix}"


@cache
def bars() -> type[tqdm[Any]]:
    from tqdm import tqdm  # here: --help has no bar

    # bars are updated at every step anyway, and its thread may fail to start
    tqdm.monitor_interval = 0
    return tqdm


@dataclass(frozen=True)
class Console:
    """Writes lines to stderr, nothing with ``quiet``; keeps the notes, for the report."""

    quiet: bool = False
    notes: list[str] = field(default_factory=list)

    def say(self, text: str) -> None:
        if not self.quiet:
            bars().write(text, file=sys.stderr)  # print would overwrite a bar on this line

    def note(self, *texts: str, of: str = "") -> None:
        """Writes and keeps notes, or warnings if they begin so, on input or output, ``of`` this
        file.
        """
        for text in texts:
            mark = WARNING * text.startswith(WARNING)
            kept = f"{mark}{of}: {text.removeprefix(mark)}" if of else text
            if kept not in self.notes:
                self.notes.append(kept)
                self.say(f"  {kept}" if mark else f"  note: {kept}")

    @contextmanager
    def status(self, text: str) -> Iterator[Callable[[str], None]]:
        """Shows on a terminal the work under way, if its progress is unknown; yields a function
        that changes it.
        """
        if self.quiet or not sys.stderr.isatty():
            yield lambda more: None
            return
        with bars()(
            bar_format="{desc}", desc=text, file=sys.stderr, leave=False, dynamic_ncols=True
        ) as shown:
            yield shown.set_description_str

    def meter(self, label: str) -> closing[Meter]:
        """The progress of a phase, until the end of the block."""
        return closing(Meter(self, label))


class Meter:
    """A listener: a bar on a terminal, otherwise a line now and then, with the time left."""

    bar: Any = None

    def __init__(self, console: Console, label: str) -> None:
        self.console = console
        self.begin(label)

    def begin(self, label: str, initial: float = 0.0) -> None:
        """Begins a phase, of which the share ``initial`` was done before."""
        self.close()
        self.label, self.initial = label, initial
        self.began = self.printed = time.perf_counter()
        if not self.console.quiet and sys.stderr.isatty():
            self.bar = bars()(
                total=1.0,
                initial=initial,
                desc=label,
                bar_format=BAR_FORMAT,
                file=sys.stderr,
                leave=False,
                delay=0.5,
                miniters=0,
                dynamic_ncols=True,
            )

    def update(self, share: float, text: str = "") -> None:
        """Shows the ``share`` that is done, in [0, 1], followed by ``text``."""
        now = time.perf_counter()
        if self.bar is not None:
            self.bar.set_postfix_str(text, refresh=False)
            self.bar.update(min(share, 1.0) - self.bar.n)
        elif now - self.printed >= LINE_EVERY:
            self.printed = now
            left = (now - self.began) * (1 - share) / max(share - self.initial, 1e-9)
            self.console.say(
                f"{self.label} {share:4.0%}, {duration(left)} left, {text}".removesuffix(", ")
            )

    def __call__(self, now: Progress) -> bool | None:
        self.update(now.share, f"{now.done}/{now.total}")
        return None

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None


class ProgressDisplay(Meter):
    """A listener that shows each phase, training as ``training``, and stops on Ctrl-C."""

    def __init__(
        self, console: Console, stop: GracefulStop, training: str = Phase.TRAINING
    ) -> None:
        self.console, self.stop, self.training = console, stop, training
        self.phase: Phase | None = None

    def __call__(self, now: Progress) -> bool:
        training = now.phase == Phase.TRAINING
        if now.phase != self.phase:
            # a resumed training's
            self.phase, before = now.phase, now.share if now.done > 1 else 0.0
            self.begin(self.training if training else now.phase, before)
        by_time = now.share > now.done / max(now.total, 1)
        self.update(now.share, f"step {now.done}" if by_time else f"{now.done}/{now.total}")
        if not now.error and not self.stop.requests:
            return True
        self.close()
        if training and not now.error:
            again = (
                " (Ctrl-C again aborts without writing)"
                if self.stop.aborts and self.stop.presses
                else ""
            )
            self.console.say(f"stopping{again}")
        return False


def duration(seconds: float) -> str:
    """``0.4 s``, ``42 s``, ``2:05``, ``1:02:05``."""
    if seconds < 59.5:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    return bars().format_interval(round(seconds)).lstrip("0")
