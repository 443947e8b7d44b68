"""``--resume``: finds the training state of an interrupted run, and checks that it belongs to this one."""

from __future__ import annotations

import argparse
import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clod_adapter._support.version import package_version
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.robustness import scene_fingerprint
from clod_adapter.gaussians import Gaussians
from clod_adapter.training.state import TrainingState, load_state

from ..commands.settings import OPTIONS
from ..shared.console import Console

# Not "leave out --resume": the demo gives that option itself.
ORIGINAL = "use the original arguments, or delete the file to start over"

RunKey = dict[str, Any]
"""Identifies a run, in its state file: version, config, hashes of base and views, overrides."""


@dataclass(frozen=True)
class Resumed:
    """The state file of an interrupted run of these settings.

    Attributes:
        run_of: the key of the run that saved it.
    """

    path: Path
    state: TrainingState
    run_of: RunKey

    def check_inputs(self, run_of: RunKey, checkpoint: str, source: str) -> None:
        """Raises ClodError if base, views, ``--with`` or ``--without`` are others.

        Args:
            checkpoint, source: names of base and views in the message.
        """
        for key, what in (
            ("base_sha256", f"another checkpoint than {checkpoint}"),
            ("views_sha256", f"other photographs than {source}"),
        ):
            if self.run_of.get(key) != run_of[key]:
                raise ClodError(f"{self.path}: is of {what}; {ORIGINAL}")
        then = self.run_of.get("overruled", {})
        if then != run_of.get("overruled", {}):  # they change the tensors
            words = " ".join(" ".join((option, *names)) for option, names in then.items() if names)
            raise ClodError(f"{self.path}: is of a run with {words or 'no --with or --without'}; {ORIGINAL}")

    def check_settings(self, run_of: RunKey) -> None:
        """Raises ClodError if version or settings are others."""
        if (then := self.run_of.get("version")) != (now := run_of["version"]):
            raise ClodError(f"{self.path}: is of version {then} of this package, not {now}; delete it to start over")
        now, then = run_of["config"], self.run_of.get("config")
        if not isinstance(then, dict) or then.keys() != now.keys():
            raise ClodError(f"{self.path}: is of other settings; {ORIGINAL}")
        different = [name for name in now if now[name] != then[name]]
        of_form = [name for name in different if name not in OPTIONS]
        if different:
            options = ", ".join(_as_option(name, then[name]) for name in different)
            what = f"another --form ({of_form[0]} {then[of_form[0]]})" if of_form else options
            raise ClodError(f"{self.path}: is of a run with {what}; {ORIGINAL}")


def find_state(path: Path, resume: bool, config: AdaptConfig, console: Console) -> Resumed | None:
    """The state to resume from; None without ``resume`` or without a file.

    Raises:
        ClodError: the file is not a training state (then it is not replaced either), is damaged, or of other settings.
    """
    if not path.exists():
        if resume:
            console.say(f"there is no {path} to resume from: starting from the beginning")
        return None
    state, run_of = load_state(path)
    if not _is_override(override := run_of.get("overruled", {})):
        raise ClodError(
            f"{path}: is not a training state or is damaged (its record has overruled {override!r:.60}); "
            "delete it to start over"
        )
    found = Resumed(path, state, run_of)
    if resume:
        found.check_settings(settings_key(config))
        return found
    console.say(
        f"{path} has step {state.steps} of an interrupted run, which --resume would continue; this run starts over, "
        "and replaces the file once its training has begun"
    )
    return None


def settings_key(config: AdaptConfig) -> RunKey:
    return {"version": package_version(), "config": asdict(config)}


def identify(
    resumed: Resumed | None, base: Gaussians, scene: Scene, config: AdaptConfig, args: argparse.Namespace,
    console: Console,
) -> RunKey:  # fmt: skip
    """The key of a run on these Gaussians and views, with these ``--with`` and ``--without``.

    Raises:
        ClodError: ``resumed`` is of others.
    """
    hashes = {"base_sha256": _fingerprint(base), "views_sha256": scene_fingerprint(scene)}
    requested = {"--with": sorted(args.keep_in), "--without": sorted(args.leave_out)}
    run_of = settings_key(config) | hashes | {"overruled": requested}
    check_resumed(resumed, run_of, args.ply, args.images or "the pseudo views", console)
    return run_of


def check_resumed(resumed: Resumed | None, run_of: RunKey, checkpoint: str, source: str, console: Console) -> None:
    """``Resumed.check_inputs``, and a message that the run is resumed."""
    if resumed:
        resumed.check_inputs(run_of, checkpoint, source)
        console.say(f"resuming {resumed.path} from step {resumed.state.steps}")


def _is_override(value: object) -> bool:
    """Whether it has names by option."""
    lists = value.values() if isinstance(value, dict) else (None,)
    return all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists)


def _as_option(name: str, value: object) -> str:
    option = f"--{name.replace('_', '-')}"
    return f"no {option}" if value is None else f"{option} {value}"


def _fingerprint(gaussians: Gaussians) -> str:
    """SHA-256, hex, of the Gaussians as read, which depends on the options for reading."""
    digest = hashlib.sha256(repr((gaussians.attenuation, gaussians.screen_filter)).encode())
    for name, tensor in gaussians.tensors().items():
        digest.update(f"{name} {tuple(tensor.shape)};".encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().numpy().data)
    return digest.hexdigest()
