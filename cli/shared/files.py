"""Names of output files and folders, checked before any work is done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from glob import escape
from pathlib import Path

from clod_adapter.errors import ClodError

from .outputs import check_no_input, check_outputs


@dataclass(frozen=True)
class Outputs:
    """The three output files of a run."""

    ply: Path
    adapter: Path
    report: Path

    @classmethod
    def of(cls, checkpoint: str, out: str | None) -> Outputs:
        """From ``out``; by default the checkpoint's name with _clod, in the current folder."""
        ply = Path(out or f"{Path(checkpoint).stem}_clod.ply")
        return cls(ply, ply.with_suffix(".safetensors"), ply.with_suffix(".json"))

    @property
    def state(self) -> Path:
        """The state for ``--resume``; exists only until the run is finished."""
        return self.ply.with_suffix(".resume.safetensors")

    def check(self, inputs: Sequence[str], scene: str | None, more: Sequence[Path]) -> None:
        """``check_outputs`` for these, for the state and blocks of a run, and for ``more``."""
        check_ply_name(self.ply, "--out")
        check_outputs([self.ply], inputs, scene, beside=[self.adapter, self.report, *more])
        blocks = self.ply.parent.glob(f"{escape(self.ply.stem)}.*.safetensors")  # read if they exist
        check_no_input([self.state, *blocks], inputs, scene)

    def names(self) -> dict[str, str]:
        return {name: str(path) for name, path in vars(self).items()}


def check_ply_name(path: Path, option: str) -> None:
    if path.suffix.lower() != ".ply":
        raise ClodError(f"{path}: {option} names the PLY to write, so it must end in .ply")


def make_folder(folder: Path) -> None:
    """Makes the folder of ``--out`` if it does not exist."""
    if folder.exists() and not folder.is_dir():
        raise ClodError(f"{folder}: is a file; --out must name a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ClodError(f"{folder}: cannot be made ({error.strerror or error}); choose another --out") from error


def labels(paths: Sequence[str]) -> list[str]:
    """A distinct label per file: its stem, with the folder's name where two stems are equal.

    Raises:
        ClodError: a file is given twice, or two labels are equal.
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
    """The size of a file, or a number of bytes, as text: ``4 kB``, ``12.3 MB``."""
    count = of if isinstance(of, int) else of.stat().st_size
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{max(count / 1e3, 1):.0f} kB"
