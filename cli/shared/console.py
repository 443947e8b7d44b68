"""Messages and progress, all on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from tqdm import tqdm

from clod_adapter.io.settings import WARNING
from clod_adapter.progress import Listener, Progress

tqdm.monitor_interval = 0  # bars are updated at every step anyway, and its thread may fail to start
LINE_EVERY = 10.0  # seconds between progress lines if stderr is not a terminal
WIDTH = 80  # of tables
TEXT = 36  # most characters of the text beside a bar, so that 80 columns have room for label, time and bar
BAR_FORMAT = "{desc} {percentage:3.0f}%|{bar}| {remaining} left{postfix}"


@dataclass(frozen=True)
class Console:
    """Writes lines to stderr; nothing with ``quiet``."""

    quiet: bool = False

    def say(self, text: str) -> None:
        if not self.quiet:
            tqdm.write(text, file=sys.stderr)  # print would overwrite a bar on this line
            sys.stderr.flush()

    def note(self, text: str) -> None:
        """Writes a note on input or output, or a warning if it begins so."""
        self.say(f"  {text}" if text.startswith(WARNING) else f"  note: {text}")

    @contextmanager
    def status(self, text: str) -> Iterator[Callable[[str], None]]:
        """Shows on a terminal the work under way, if its progress is unknown.

        Yields a function that changes the text; without a terminal it writes a line now and then.
        """
        shown, printed = None, time.perf_counter()
        if not self.quiet and sys.stderr.isatty():
            shown = tqdm(bar_format="{desc}", desc=text, file=sys.stderr, leave=False, dynamic_ncols=True)

        def show(more: str) -> None:
            nonlocal printed
            if shown is not None:
                shown.set_description_str(more)
            elif time.perf_counter() - printed >= LINE_EVERY:
                printed = time.perf_counter()
                self.say(more)

        try:
            yield show
        finally:
            if shown is not None:
                shown.close()

    @contextmanager
    def meter(self, label: str) -> Iterator[Meter]:
        """The progress of a phase, until the end of the block."""
        meter = Meter(self, label)
        try:
            yield meter
        finally:
            meter.close()


@dataclass
class Meter:
    """Progress with the time left: a bar on a terminal, otherwise a line now and then. Is a ``progress.Listener``.

    Args:
        slow: for few and uneven steps: shown from the start, with the time left from the mean pace.
        initial: the share that was done before.
    """

    console: Console
    label: str
    slow: bool = False
    initial: float = 0.0
    bar: Any = None
    began: float = field(default_factory=time.perf_counter)
    printed: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        if not self.console.quiet and sys.stderr.isatty():
            self.bar = tqdm(
                total=1.0, initial=self.initial, desc=self.label, bar_format=BAR_FORMAT, file=sys.stderr,
                leave=False, delay=0 if self.slow else 0.5, smoothing=0 if self.slow else 0.3,
                miniters=0, dynamic_ncols=True,
            )  # fmt: skip

    def update(self, share: float, text: str = "") -> None:
        """Shows the ``share`` that is done, in [0, 1], followed by ``text``."""
        now, text = time.perf_counter(), clipped(text, TEXT)
        if self.bar is not None:
            self.bar.set_postfix_str(text, refresh=False)
            self.bar.update(min(share, 1.0) - self.bar.n)
        elif now - self.printed >= LINE_EVERY:
            self.printed = now
            left = (now - self.began) * (1 - share) / max(share - self.initial, 1e-9)
            self.console.say(f"{self.label} {share:4.0%}, {duration(left)} left, {text}".removesuffix(", "))

    def __call__(self, now: Progress) -> None:
        self.update(now.share, f"{now.done}/{now.total}")

    def part(self, index: int, count: int, text: str) -> Listener:
        """The listener of the ``index``-th of ``count`` equal parts."""
        return lambda now: self.update((index + now.share) / count, text)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None


def put(text: str, end: str = "\n") -> None:
    """Prints a result on stdout."""
    print(text, end=end)


def command_line(*parts: str) -> str:
    """An indented command."""
    return f"  {' '.join(parts)}"


def clipped(text: str, most: int) -> str:
    """``text`` with at most this many characters."""
    return text if len(text) <= most else f"{text[: most - 3].rstrip()}..."


def duration(seconds: float) -> str:
    """``0.4 s``, ``42 s``, ``2:05``, ``1:02:05``."""
    if seconds < 59.5:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
