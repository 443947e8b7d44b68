"""Names of output files and folders, checked before any work is done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from glob import escape
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import check_suffix


@dataclass(frozen=True)
class AdaptFiles:
    """The three output files of adapting."""

    ply: Path
    adapter: Path
    report: Path

    @classmethod
    def of(cls, checkpoint: str, out: str | None) -> AdaptFiles:
        """From ``out``; by default the checkpoint's name with _clod, in the current folder."""
        ply = Path(out or f"{Path(checkpoint).stem}_clod.ply")
        return cls(ply, ply.with_suffix(".safetensors"), ply.with_suffix(".json"))

    @property
    def state(self) -> Path:
        """The state for ``--resume``; exists only until the run is finished."""
        return self.ply.with_suffix(".resume.safetensors")

    def blocks(self) -> list[Path]:
        """Existing files of an unfinished run in blocks (``adapt.block_files``)."""
        stem = escape(self.ply.stem)
        names = (f"{stem}.start.safetensors", f"{stem}.block*.pass*.safetensors")
        return [path for name in names for path in self.ply.parent.glob(name)]

    def names(self) -> dict[str, str]:
        return {name: str(path) for name, path in vars(self).items()}


def check_ply_name(path: Path, option: str) -> None:
    if path.suffix.lower() != ".ply":
        raise ClodError(f"{path}: {option} names the PLY to write, so it must end in .ply")
    check_suffix(path)  # .compressed.ply


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
