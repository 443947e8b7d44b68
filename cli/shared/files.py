"""The files of the commands: their names, checked before work is spent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from glob import escape
from pathlib import Path

from clod_adapter.errors import ClodError

from .outputs import check_no_input, check_outputs


@dataclass(frozen=True)
class Outputs:
    """The three files of a run."""

    ply: Path
    adapter: Path
    report: Path

    @classmethod
    def of(cls, checkpoint: str, out: str | None) -> Outputs:
        """Beside ``out``, by default the checkpoint's name with _clod in the current folder."""
        ply = Path(out or f"{Path(checkpoint).stem}_clod.ply")
        return cls(ply, ply.with_suffix(".safetensors"), ply.with_suffix(".json"))

    @property
    def state(self) -> Path:
        """What ``--resume`` goes on from; there only while a run is not finished."""
        return self.ply.with_suffix(".resume.safetensors")

    def check(self, inputs: Sequence[str], scene: str | None, more: Sequence[Path]) -> None:
        """``check_outputs`` for them, the states and blocks of a run, and ``more``."""
        check_ply_name(self.ply, "--out")
        check_outputs([self.ply], inputs, scene, beside=[self.adapter, self.report, *more])
        blocks = self.ply.parent.glob(f"{escape(self.ply.stem)}.*.safetensors")  # which are looked into when found
        check_no_input([self.state, *blocks], inputs, scene)

    def names(self) -> dict[str, str]:
        return {name: str(path) for name, path in vars(self).items()}


def check_ply_name(path: Path, option: str) -> None:
    if path.suffix.lower() != ".ply":
        raise ClodError(f"{path}: {option} names the PLY to write, so it must end in .ply")


def make_folder(folder: Path) -> None:
    """Makes ``--out`` a folder, where it is none yet."""
    if folder.exists() and not folder.is_dir():
        raise ClodError(f"{folder}: is a file; give --out the name of a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ClodError(f"{folder}: cannot be made ({error.strerror or error}); choose another --out") from error


def labels(paths: Sequence[str]) -> list[str]:
    """Names of files that tell them apart: the stem, with its folder where two stems are the same.

    Raises:
        ClodError: a file is given twice, or two have the same name all the same.
    """
    resolved = [Path(path).resolve() for path in paths]
    if len(set(resolved)) < len(resolved):
        raise ClodError(f"{next(p for k, p in enumerate(paths) if resolved[k] in resolved[:k])}: is given twice")
    stems = [path.stem for path in resolved]
    names = [f"{p.parent.name}_{p.stem}" if stems.count(p.stem) > 1 else p.stem for p in resolved]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise ClodError(f"{paths[k]}: has the same name as {paths[names.index(name)]}; rename one of them")
    return names


def size(of: Path | int) -> str:
    """Of a file, or of so many bytes: ``4 kB``, ``12.3 MB``."""
    count = of if isinstance(of, int) else of.stat().st_size
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{max(count / 1e3, 1):.0f} kB"
