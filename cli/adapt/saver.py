"""Saves the training state beside the output now and then, for ``--resume``."""

from __future__ import annotations

import math
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.progress import Listener, Progress, Stopped
from clod_adapter.training.state import StateRefused, save_state

from ..shared.console import Console
from ..shared.process import GracefulStop
from .resume import Resumed, RunKey

SAVE_EVERY = 5.0  # seconds between saves, at least
SAVE_COST = 0.015  # share of the training time that saving may take, except the first save, within OLDEST
OLDEST = 50.0  # seconds that the state may be old once the next step and save are done
MOST_COST = 0.2  # share of the time that saving takes at most, whatever the disk


class Saver:
    """Saves the training state of one run.

    Attributes:
        saved: the step that is in the file; None if the file is not of this run.
        latest: the last progress that is not saved; it references everything that is trained.
        seconds, saves: time spent saving, and how often.
    """

    def __init__(
        self, path: Path, run_of: RunKey, resumed: Resumed | None, console: Console, stop: GracefulStop
    ) -> None:
        self.path, self.run_of, self.console, self.stop = path, run_of, console, stop
        self.saved = resumed.state.steps if resumed else None
        self.latest: Progress | None = None
        self.seconds, self.saves, self.warned = 0.0, 0, False
        self.began, self.due, self.oldest, self.heard = math.inf, 0.0, math.inf, math.inf

    def saving(self, listener: Listener) -> Listener:
        """The listener that also saves: after the first step, now and then, and when training stops or fails."""

        def listen(now: Progress) -> bool:
            self.latest = now if now.state else None
            try:
                going = listener(now) is not False
            except Exception:
                self._save(now)
                raise
            stopping = (not going or now.error) and not self.stop.aborted
            at = time.perf_counter()
            due = min(self.due, self.oldest - max(at - self.heard, 0.0))  # the next step may take as long as this one
            if stopping or (at >= due and now.share < 1):
                self._save(now)
            self.heard = time.perf_counter()
            return going

        return listen

    def _save(self, progress: Progress) -> None:
        """Saves the state, if there is one. If that fails, training continues."""
        if progress.state is None:
            return
        began = time.perf_counter()
        self.began = min(self.began, began)
        try:
            save_state(self.path, progress.state(), self.run_of)
            self.saved, self.latest = progress.done, None
        except (ClodError, MemoryError) as error:
            if not self.warned:
                self.console.say(f"warning: the run continues, but --resume will not find it: {error}")
            self.warned = True
        now = time.perf_counter()
        cost = now - began
        self.seconds, self.saves = self.seconds + cost, self.saves + 1
        self.due = max(now + SAVE_EVERY, self.began + (self.seconds + cost) / SAVE_COST)
        self.oldest = began + max(OLDEST - cost, cost / MOST_COST)

    def keep(self) -> None:
        """Saves the end of the training, so that later steps may fail; if that fails, ``rescue`` saves it elsewhere."""
        if self.latest is not None:
            self._save(self.latest)

    @contextmanager
    def rescuing(self, how: str = "--resume") -> Iterator[None]:
        """Calls ``rescue`` on an error within the block; after an abort only names the saved step.

        Raises:
            ClodError: the state to resume from was refused; names its file.
        """
        try:
            yield
        except Stopped:
            raise
        except StateRefused as error:
            raise ClodError(f"{self.path}: {str(error).partition(';')[0]}; delete it to start over") from error
        except KeyboardInterrupt:
            if self.saved is not None:
                _tell(f"{how} resumes from step {self.saved}, which is in {self.path}")
            raise
        except Exception:
            self.rescue(how)
            raise

    def rescue(self, how: str = "--resume") -> None:
        """After an error: says on stderr, also with ``--quiet``, from which step ``how`` resumes.

        A state that cannot be saved beside the output is saved in a new folder for temporary files.
        """
        self.keep()
        if self.latest is not None and (path := self._save_elsewhere(self.latest)):
            _tell(f"step {self.latest.done} is in {path}: move it to {self.path}, and {how} resumes from there")
        elif self.saves and self.saved is not None:
            _tell(f"{how} resumes from step {self.saved}, which is in {self.path}")

    def _save_elsewhere(self, progress: Progress) -> Path | None:
        """The file, if it could be saved."""
        assert progress.state is not None
        try:
            folder = Path(tempfile.mkdtemp(prefix="clod-adapt-"))
        except OSError:
            return None
        try:
            save_state(folder / self.path.name, progress.state(), self.run_of)
        except (ClodError, MemoryError):
            folder.rmdir()
            return None
        return folder / self.path.name

    def close(self, finished: bool) -> None:
        """Removes the run's file if the run is finished, else says how to resume."""
        self.latest = None
        if self.saved is None:
            return
        if finished:
            self.path.unlink(missing_ok=True)
            self.saved = None
        else:
            self.console.say(f"--resume resumes from step {self.saved}, which is in {self.path}")


def _tell(text: str) -> None:
    with suppress(OSError):  # stderr is closed, or on the disk that is full
        print(text, file=sys.stderr)
