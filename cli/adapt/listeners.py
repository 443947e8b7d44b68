"""The saver of the training state, which also finds and checks the one to resume from."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from clod_adapter import AdaptConfig, ClodError, Progress, Stopped
from clod_adapter._support.text import package_version
from clod_adapter.progress import GracefulStop, Listener
from clod_adapter.training.state import StateRejected, TrainingState, load_state, save_state

from ..shared.command import SETTINGS, as_option
from ..shared.console import Console

# Not "leave out --resume": the demo gives that option itself.
ORIGINAL = "use the original arguments, or delete the file to start over"
# seconds between saves, at least, and unless saving takes very long at most
SAVE_EVERY, OLDEST = 5.0, 50.0
# shares of the time that saving may take, within OLDEST and at all
SAVE_COST, MOST_COST = 0.015, 0.2


class Saver:
    """Saves the training state of one run; finds that of an earlier one, of the same settings, with
    ``resume``.

    A file that is no training state is refused, and not replaced.
    """

    def __init__(
        self, path: Path, config: AdaptConfig, console: Console, stop: GracefulStop, resume: bool
    ) -> None:
        self.path, self.console, self.stop = path, console, stop
        self.run_of: dict[str, Any] = {"version": package_version(), "config": asdict(config)}
        self.state: TrainingState | None = None  # the one to resume from
        # the step that is in the file; None if the file is not of this run
        self.saved: int | None = None
        # the last that is not saved; it references everything that is trained
        self.latest: Progress | None = None
        self.due, self.warned = 0.0, False  # when the next save is, and whether one has failed
        if path.exists():
            found, self.then = load_state(path)
            if resume:
                self._check_settings()
                self.state = found
            else:
                console.say(
                    f"{path} has step {found.steps} of an interrupted run, which --resume would"
                    " continue; this run starts over, and replaces the file once its training has"
                    " begun"
                )
        elif resume:
            console.say(f"there is no {path} to resume from: starting from the beginning")

    def _check_settings(self) -> None:
        if (then := self.then.get("version")) != (now := self.run_of["version"]):
            raise ClodError(
                f"{self.path}: is of version {then} of this package, not {now}; delete it to start"
                " over"
            )
        now, then = self.run_of["config"], self.then.get("config")
        if not isinstance(then, dict) or then.keys() != now.keys():
            raise ClodError(f"{self.path}: is of other settings; {ORIGINAL}")
        if different := [name for name in now if now[name] != then[name]]:
            given = {
                name: f"{as_option(name)} {then[name]}" for name in different if name in SETTINGS
            }
            given |= {name: f"no {as_option(name)}" for name in given if then[name] is None}
            options = [given.get(name, "another --form") for name in different]
            raise ClodError(
                f"{self.path}: is of a run with {', '.join(dict.fromkeys(options))}; {ORIGINAL}"
            )

    def identify(self, checkpoint: str, source: str, **hashes: Any) -> None:
        """Sets what else identifies the run: hashes of base and views, and overrides; refuses the
        state of another.

        ``checkpoint`` and ``source`` are the names of base and views.
        """
        self.run_of |= hashes
        if self.state is None:
            return
        for key, what in (
            ("base_sha256", f"another checkpoint than {checkpoint}"),
            ("views_sha256", f"other photographs than {source}"),
            (
                "overruled",
                f"a run with other --with or --without, {self.then.get('overruled')!r:.80}",
            ),
        ):
            if self.then.get(key) != self.run_of.get(key):
                raise ClodError(f"{self.path}: is of {what}; {ORIGINAL}")
        self.saved = self.state.steps
        self.console.say(f"resuming {self.path} from step {self.saved}")

    def saving(self, listener: Listener) -> Listener:
        """The listener that also saves: after the first step, now and then, and when training stops
        or fails.
        """

        def listen(now: Progress) -> bool:
            self.latest = now if now.state else None
            going = listener(now) is not False
            stopping = (not going or now.error) and not self.stop.aborted
            if stopping or (time.perf_counter() >= self.due and now.share < 1):
                self.keep()
            return going

        return listen

    def keep(self) -> None:
        """Saves the latest state, if it is not saved yet. If that fails, the run continues."""
        if self.latest is None or self.latest.state is None:
            return
        began = time.perf_counter()
        try:
            save_state(self.path, self.latest.state(), self.run_of)
            self.saved, self.latest = self.latest.done, None
        except (ClodError, MemoryError) as error:
            if not self.warned:
                self.console.say(
                    f"warning: the run continues, but --resume will not find it: {error}"
                )
            self.warned = True
        now = time.perf_counter()
        cost = now - began
        self.due = now + max(SAVE_EVERY, min(cost / SAVE_COST, OLDEST), cost / MOST_COST)

    @contextmanager
    def rescuing(self) -> Iterator[None]:
        """After an error within the block says on stderr, also with ``--quiet``, from which step
        ``--resume`` resumes.
        """
        try:
            yield
        except Stopped:
            raise
        except StateRejected as error:
            raise ClodError(
                f"{self.path}: {str(error).partition(';')[0]}; delete it to start over"
            ) from error
        except BaseException as error:
            if isinstance(error, Exception):  # not after an abort
                self.keep()
            if self.saved is not None:
                with suppress(OSError):  # stderr is closed, or on the disk that is full
                    print(
                        f"--resume resumes from step {self.saved}, which is in {self.path}",
                        file=sys.stderr,
                    )
            raise

    def close(self, finished: bool) -> None:
        """Removes the run's file if the run is finished, else says how to resume."""
        self.latest = None
        if self.saved is None:
            return
        if finished:
            try:
                self.path.unlink(missing_ok=True)
            except OSError as error:
                self.console.note(
                    f"{self.path}: cannot be removed ({error.strerror or error}); it is of no"
                    " use now"
                )
            self.saved = None
        else:
            self.console.say(f"--resume resumes from step {self.saved}, which is in {self.path}")
