"""Inputs and outputs as the commands share them: read with a word to the user, checked before work is spent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from clod_adapter.cameras import Scene
from clod_adapter.cli.console import Console
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import check_target
from clod_adapter.io.colmap import load_scene
from clod_adapter.io.ply import Checkpoint, load


@dataclass(frozen=True)
class Outputs:
    """The three files of a run."""

    ply: Path
    adapter: Path
    report: Path

    @classmethod
    def beside(cls, ply: Path) -> Outputs:
        return cls(ply, ply.with_suffix(".safetensors"), ply.with_suffix(".json"))

    def check(self, inputs: Sequence[str]) -> None:
        """``check_output`` for each of them."""
        check_ply_name(self.ply, "--out")
        for path in vars(self).values():
            check_output(path, inputs)

    def names(self) -> dict[str, str]:
        return {name: str(path) for name, path in vars(self).items()}


def read_checkpoint(path: str, console: Console) -> Checkpoint:
    """Reads a PLY and says what is in it."""
    checkpoint = load(path)
    gaussians = checkpoint.gaussians
    dial = ", with sigma_d" if gaussians.sigma_d is not None else ""
    console.say(f"{path}: {len(gaussians):,} Gaussians, SH degree {gaussians.sh_degree}{dial}")
    for note in checkpoint.notes:
        console.say(f"  note: {note}")
    return checkpoint


def read_scene(folder: str, console: Console) -> Scene:
    """Reads the photographs and says how they are used."""
    if not Path(folder).is_dir():
        raise ClodError(f"{folder}: is not a folder; give the one that holds images/ and sparse/0")
    with console.meter("photographs") as meter:
        scene = load_scene(folder, progress=lambda done, total: meter.update(done / total, f"{done}/{total}"))
    camera = scene.train[0].camera
    size = f"{camera.width}x{camera.height}"
    console.say(f"{folder}: {len(scene.train)} photographs to train on, {len(scene.test)} held out, {size}")
    for note in scene.notes:
        console.say(f"  note: {note}")
    return scene


def check_output(path: Path, inputs: Sequence[str]) -> None:
    """Refuses, before any work is done, an output that could not be written or would replace an input."""
    check_target(path)
    if path.is_dir():
        raise ClodError(f"{path}: is a folder; give the name of a file in it")
    for given in map(Path, inputs):
        if path.exists() and given.exists() and path.samefile(given):
            raise ClodError(f"{path}: is an input file, which is never overwritten; choose another output")


def check_ply_name(path: Path, option: str) -> None:
    if path.suffix.lower() != ".ply":
        raise ClodError(f"{path}: {option} names the PLY to write, so it must end in .ply")


def size(path: Path) -> str:
    """Of a file: ``4 kB``, ``12.3 MB``."""
    count = path.stat().st_size
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{max(count / 1e3, 1):.0f} kB"
