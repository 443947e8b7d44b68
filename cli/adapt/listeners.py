"""The listeners of a training: its display, and the saver of the state that ``--resume`` finds and checks."""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clod_adapter._support.version import package_version
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Listener, Phase, Progress, Stopped
from clod_adapter.training.state import StateRefused, TrainingState, load_state, save_state

from ..shared.console import Console, Meter
from ..shared.process import GracefulStop
from ..shared.settings import OPTIONS

# Not "leave out --resume": the demo gives that option itself.
ORIGINAL = "use the original arguments, or delete the file to start over"
SAVE_EVERY, OLDEST = 5.0, 50.0  # seconds between saves, at least, and unless saving takes very long at most
SAVE_COST, MOST_COST = 0.015, 0.2  # shares of the time that saving may take, within OLDEST and at all

RunKey = dict[str, Any]
"""Identifies a run, in its state file: version, config, hashes of base and views, and overrides."""


@dataclass(frozen=True)
class Resumed:
    """The state file of an interrupted run.

    Attributes:
        run_of: the key of the run that saved it.
    """

    path: Path
    state: TrainingState
    run_of: RunKey

    def check_settings(self, run_of: RunKey) -> None:
        """Raises ClodError if version or settings are others."""
        if (then := self.run_of.get("version")) != (now := run_of["version"]):
            raise ClodError(f"{self.path}: is of version {then} of this package, not {now}; delete it to start over")
        now, then = run_of["config"], self.run_of.get("config")
        if not isinstance(then, dict) or then.keys() != now.keys():
            raise ClodError(f"{self.path}: is of other settings; {ORIGINAL}")
        if different := [name for name in now if now[name] != then[name]]:
            options = [_as_option(name, then[name]) if name in OPTIONS else "another --form" for name in different]
            raise ClodError(f"{self.path}: is of a run with {', '.join(dict.fromkeys(options))}; {ORIGINAL}")

    def check(self, run_of: RunKey, checkpoint: str, source: str) -> None:
        """Raises ClodError if base, views, ``--with`` or ``--without`` are others.

        Args:
            checkpoint, source: names of base and views in the message.
        """
        then = self.run_of.get("overruled", {})
        for key, what in (
            ("base_sha256", f"another checkpoint than {checkpoint}"),
            ("views_sha256", f"other photographs than {source}"),
            ("overruled", f"a run with other --with or --without, {then!r:.80}"),  # they change the tensors
        ):
            if self.run_of.get(key) != run_of.get(key):
                raise ClodError(f"{self.path}: is of {what}; {ORIGINAL}")


def find_state(path: Path, resume: bool, config: AdaptConfig, console: Console) -> Resumed | None:
    """The state to resume from; None without ``resume`` or without a file.

    Raises:
        ClodError: the file is not a training state (then it is not replaced either), is damaged, or of other settings.
    """
    if not path.exists():
        if resume:
            console.say(f"there is no {path} to resume from: starting from the beginning")
        return None
    found = Resumed(path, *load_state(path))
    if resume:
        found.check_settings(settings_key(config))
        return found
    console.say(
        f"{path} has step {found.state.steps} of an interrupted run, which --resume would continue; this run starts "
        "over, and replaces the file once its training has begun"
    )
    return None


def settings_key(config: AdaptConfig) -> RunKey:
    return {"version": package_version(), "config": asdict(config)}


def fingerprint(gaussians: Gaussians) -> str:
    """SHA-256, hex, of the Gaussians as read, which depends on the options for reading."""
    digest = hashlib.sha256(repr((gaussians.attenuation, gaussians.screen_filter)).encode())
    for name, tensor in gaussians.tensors().items():
        digest.update(f"{name} {tuple(tensor.shape)};".encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().numpy().data)
    return digest.hexdigest()


def _as_option(name: str, value: object) -> str:
    option = f"--{name.replace('_', '-')}"
    return f"no {option}" if value is None else f"{option} {value}"


class ProgressDisplay:
    """A listener that shows progress, and stops on Ctrl-C.

    Args:
        training: the label of ``Phase.TRAINING``.
    """

    def __init__(self, console: Console, stop: GracefulStop, training: str = Phase.TRAINING) -> None:
        self.console, self.stop, self.training = console, stop, training
        self.phase: Phase | None = None
        self.meter: Meter | None = None

    def __call__(self, now: Progress) -> bool:
        training = now.phase == Phase.TRAINING
        if self.meter is None or now.phase != self.phase:
            self.close()
            self.phase, before = now.phase, now.share if now.done > 1 else 0.0  # a resumed training's
            self.meter = Meter(self.console, self.training if training else now.phase, initial=before)
        by_time = now.share > now.done / max(now.total, 1)
        self.meter.update(now.share, f"step {now.done}" if by_time else f"{now.done}/{now.total}")
        if not now.error and not self.stop.requests:
            return True
        self.close()
        if training and not now.error:
            again = " (Ctrl-C again aborts without writing)" if self.stop.aborts and self.stop.presses else ""
            self.console.say(f"stopping{again}")
        return False

    def close(self) -> None:
        if self.meter is not None:
            self.meter.close()
            self.meter = None


class Saver:
    """Saves the training state of one run.

    Args:
        resumed: the state that the run continues from; is checked.
        names: of base and views, as for ``Resumed.check``.

    Attributes:
        saved: the step that is in the file; None if the file is not of this run.
        latest: the last progress that is not saved; it references everything that is trained.
        due: when the next save is.
    """

    def __init__(
        self, path: Path, run_of: RunKey, resumed: Resumed | None, console: Console, stop: GracefulStop,
        names: tuple[str, str] = ("", ""),
    ) -> None:  # fmt: skip
        self.path, self.run_of, self.console, self.stop = path, run_of, console, stop
        self.saved = None
        if resumed:
            resumed.check(run_of, *names)
            console.say(f"resuming {resumed.path} from step {resumed.state.steps}")
            self.saved = resumed.state.steps
        self.latest: Progress | None = None
        self.due, self.warned = 0.0, False

    def saving(self, listener: Listener) -> Listener:
        """The listener that also saves: after the first step, now and then, and when training stops or fails."""

        def listen(now: Progress) -> bool:
            self.latest = now if now.state else None
            try:
                going = listener(now) is not False
            except Exception:
                self.keep()
                raise
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
                self.console.say(f"warning: the run continues, but --resume will not find it: {error}")
            self.warned = True
        now = time.perf_counter()
        cost = now - began
        self.due = now + max(SAVE_EVERY, min(cost / SAVE_COST, OLDEST), cost / MOST_COST)

    @contextmanager
    def rescuing(self, how: str = "--resume") -> Iterator[None]:
        """After an error within the block says on stderr, also with ``--quiet``, from which step ``how`` resumes.

        Raises:
            ClodError: the state to resume from was refused; names its file.
        """
        try:
            yield
        except Stopped:
            raise
        except StateRefused as error:
            raise ClodError(f"{self.path}: {str(error).partition(';')[0]}; delete it to start over") from error
        except BaseException as error:
            if isinstance(error, Exception):  # not after an abort
                self.keep()
            if self.saved is not None:
                with suppress(OSError):  # stderr is closed, or on the disk that is full
                    print(f"{how} resumes from step {self.saved}, which is in {self.path}", file=sys.stderr)
            raise

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
