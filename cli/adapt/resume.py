"""``--resume``: the state of a training, saved beside its output now and then, and gone on from."""

from __future__ import annotations

import hashlib
import math
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.robustness import scene_fingerprint
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import remove_leftovers
from clod_adapter.training.state import Progress, StateRefused, TrainingState
from clod_adapter.training.state_file import load_state, save_state
from clod_adapter.version import package_version

from ..commands.settings import OPTIONS
from ..shared.console import Console
from ..shared.interrupts import GracefulStop

# Not "leave out --resume", which the demo gives by itself.
BEGUN = "give what it was begun with, or remove it to start afresh"
SAVE_EVERY = 5.0  # seconds between saves, at least
SAVE_COST = 0.015  # share of the training that all of them may take; only the first is not asked


class Saver:
    """The state file of one run.

    Attributes:
        state: what to go on from, where ``--resume`` found it.
        saved: the step that the file of this run is of; None where it has written none yet.
        latest: where the training of this run stands that is not saved yet; it holds on to all that is trained.
        seconds, saves: spent in saving, and how often.

    Raises:
        ClodError: the file to resume from is damaged, or of other settings.
    """

    def __init__(self, path: Path, resume: bool, config: AdaptConfig, console: Console, stop: GracefulStop) -> None:
        self.path, self.console, self.stop = path, console, stop
        self.belongs: dict[str, Any] = {"version": package_version(), "config": asdict(config)}
        self.found: dict[str, Any] = {}
        self.state: TrainingState | None = None
        self.saved: int | None = None
        self.latest: Progress | None = None
        self.seconds, self.saves, self.warned = 0.0, 0, False
        self.began, self.due = math.inf, 0.0
        remove_leftovers(path)
        if path.exists():
            self._look(resume)
        elif resume:
            console.say(f"there is no {path} to resume from: starting from the beginning")

    def _look(self, resume: bool) -> None:
        """Reads the file that is there; also where it is only to be replaced, so that no other file ever is."""
        state, found = load_state(self.path)
        if (wrong := _wrong_entry(found)) is not None:
            raise ClodError(
                f"{self.path}: is no training state or damaged (its record has {wrong} {found[wrong]!r:.60}); "
                "remove it to start afresh"
            )
        if resume:
            self.state, self.found, self.saved = state, found, state.steps
            self._refuse_other_settings()
        else:
            self.console.say(
                f"{self.path} has step {state.steps} of a run that was interrupted, with which --resume would go on; "
                "this run begins anew, and replaces it once its own training has begun"
            )

    def belong(self, base: Gaussians, scene: Scene, checkpoint: str, source: str) -> None:
        """Says what the states to come belong to, and refuses the one found where it belongs to something else.

        Args:
            checkpoint, source: where ``base`` and the views are from, for the messages.
        """
        self.claim(_fingerprint(base), scene_fingerprint(scene), checkpoint, source)

    def claim(self, base: str, views: str, checkpoint: str, source: str) -> None:
        """``belong`` by the fingerprints of base and views."""
        self.belongs |= {"base_sha256": base, "views_sha256": views}
        if self.state is None:
            return
        for key, what in (
            ("base_sha256", f"another checkpoint than {checkpoint}"),
            ("views_sha256", f"other photographs than {source}"),
        ):
            if self.found.get(key) != self.belongs[key]:
                raise ClodError(f"{self.path}: is of {what}; {BEGUN}")
        self.console.say(f"resuming {self.path} from step {self.state.steps}")

    def naming(self, error: StateRefused) -> ClodError:
        """What the state found was refused for, with the name of its file."""
        return ClodError(f"{self.path}: {str(error).partition(';')[0]}; remove it to start afresh")

    def _refuse_other_settings(self) -> None:
        if (then := self.found.get("version")) != (now := self.belongs["version"]):
            raise ClodError(f"{self.path}: is of version {then} of this package, not {now}; remove it to start afresh")
        now, then = self.belongs["config"], self.found.get("config")
        if not isinstance(then, dict) or then.keys() != now.keys():
            raise ClodError(f"{self.path}: is of other settings; {BEGUN}")
        different = [name for name in now if now[name] != then[name]]
        options = [_as_option(name, then[name]) for name in different if name in OPTIONS]
        if options or different:
            what = ", ".join(options) or f"another --form ({different[0]} {then[different[0]]})"
            raise ClodError(f"{self.path}: is of a run with {what}; {BEGUN}")

    @property
    def frozen(self) -> list[str] | None:
        """The attributes that the run to go on with froze; None where there is none."""
        return list(self.found.get("frozen", [])) if self.state is not None else None

    def watching(self, follow: Callable[[Progress], None]) -> Callable[[Progress], None]:
        """The progress callback that also saves: after the first step, now and then, and when training is stopped.

        An error of ``follow`` stops it too.
        """

        def call(progress: Progress) -> None:
            self.latest = progress if progress.state else None
            try:
                follow(progress)
            except (KeyboardInterrupt, Exception):
                if not self.stop.aborted:
                    self._save(progress)
                raise
            if time.perf_counter() >= self.due and progress.share < 1:
                self._save(progress)

        return call

    def _save(self, progress: Progress) -> None:
        """Saves, if there is something to be saved. Where that fails training goes on, which matters more."""
        if progress.state is None:
            return
        began = time.perf_counter()
        self.began = min(self.began, began)
        try:
            save_state(self.path, progress.state(), self.belongs)
            self.saved, self.latest = progress.done, None
        except (ClodError, MemoryError) as error:
            if not self.warned:
                self.console.say(f"warning: the run goes on, but --resume will not know of it: {error}")
            self.warned = True
        now = time.perf_counter()
        cost = now - began
        self.seconds, self.saves = self.seconds + cost, self.saves + 1
        self.due = max(now + SAVE_EVERY, self.began + (self.seconds + cost) / SAVE_COST)

    def keep(self) -> None:
        """Saves where training has ended, so that what comes after it can fail. Where it cannot, see ``rescue``."""
        if self.latest is not None:
            self._save(self.latest)

    def rescue(self, how: str = "--resume") -> None:
        """After a failure: says what goes on from where, on stderr also with ``--quiet``.

        What could not be saved beside the output is saved in a new folder for temporary files.
        """
        self.keep()
        if self.latest is not None and (path := self._save_elsewhere(self.latest)):
            _tell(f"step {self.latest.done} is in {path}: move it to {self.path}, and {how} goes on from there")
        elif self.saves and self.saved is not None:
            _tell(f"{how} goes on from step {self.saved}, which is in {self.path}")

    def _save_elsewhere(self, progress: Progress) -> Path | None:
        """Where, if it could."""
        assert progress.state is not None
        try:
            folder = Path(tempfile.mkdtemp(prefix="clod-adapt-"))
        except OSError:
            return None
        try:
            save_state(folder / self.path.name, progress.state(), self.belongs)
        except (ClodError, MemoryError):
            folder.rmdir()
            return None
        return folder / self.path.name

    def close(self, finished: bool) -> None:
        """Removes this run's file, or says what it is for; one of another run that it has not replaced stays."""
        self.latest = None
        if self.saved is None:
            return
        if finished:
            self.path.unlink(missing_ok=True)
            self.saved = None
        else:
            self.console.say(f"--resume goes on from step {self.saved}, which is in {self.path}")


def _tell(text: str) -> None:
    with suppress(OSError):  # stderr is closed, or on the disk that is full
        print(text, file=sys.stderr)


def _wrong_entry(found: dict[str, Any]) -> str | None:
    """Which entry of a state's record is of the wrong type, of those that are more than compared."""
    frozen, overruled = found.get("frozen", []), found.get("overruled", {})
    if not _is_words(frozen):
        return "frozen"
    if not isinstance(overruled, dict) or not all(map(_is_words, overruled.values())):
        return "overruled"
    return None


def _is_words(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(word, str) for word in value)


def _as_option(name: str, value: object) -> str:
    option = f"--{name.replace('_', '-')}"
    return f"no {option}" if value is None else f"{option} {value}"


def _fingerprint(gaussians: Gaussians) -> str:
    """SHA-256, hex, of the Gaussians as they were read, which the options of reading have a part in."""
    digest = hashlib.sha256(repr((gaussians.attenuation, gaussians.screen_filter)).encode())
    for name, tensor in gaussians.tensors().items():
        digest.update(f"{name} {tuple(tensor.shape)};".encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().numpy().data)
    return digest.hexdigest()
