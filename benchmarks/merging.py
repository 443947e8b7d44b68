"""Merging without training: ``splat-transform --decimate`` (NanoGS's pairwise merging), with a cache of its files."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from plyfile import PlyData, PlyElement

import clod_adapter as clod
from clod_adapter.io.formats.splat_transform import SplatTransform

TIMEOUT = 3600.0  # seconds


@dataclass(frozen=True)
class Merger:
    """The tool, and a cache of its files.

    Attributes:
        tool: splat-transform; files of another version are not used.
        cache: the folder, made when needed.
    """

    tool: SplatTransform
    cache: Path

    @property
    def version(self) -> str:
        return self.tool.version

    @classmethod
    def find(cls, cache: Path) -> Merger:
        """The installed tool; exits with the install command where it is missing or too old."""
        try:
            return cls(replace(SplatTransform.find(), gpu=False), cache)
        except clod.ClodError as error:
            sys.exit(str(error))

    def merge(self, base: clod.Checkpoint, count: int) -> tuple[clod.Gaussians, float]:
        """The base merged to ``count`` Gaussians, and the seconds that the tool took, then or now."""
        self.cache.mkdir(parents=True, exist_ok=True)
        out = self.cache / f"{base.fingerprint[:12]}-{self.version}-{count}.ply"
        clock = out.with_suffix(".seconds")
        if not (out.exists() and clock.exists()):
            # In a folder of its own: another benchmark may want the same file now.
            with tempfile.TemporaryDirectory(dir=self.cache) as folder:
                seconds = self._run(base, count, Path(folder))
                clock.write_text(f"{seconds:.2f}\n", encoding="utf-8")
                (Path(folder) / "merged.ply").replace(out)
        return clod.load(out).gaussians, float(clock.read_text(encoding="utf-8"))

    def _run(self, base: clod.Checkpoint, count: int, folder: Path) -> float:
        """Writes ``merged.ply`` into the folder; the seconds it took."""
        source, merged = folder / "base.ply", folder / "merged.ply"
        _write_plain(source, base)
        try:
            return self.tool.run("-q", source, "--decimate", str(count), merged, timeout=TIMEOUT)
        except clod.ClodError as error:
            sys.exit(str(error))


def _write_plain(path: Path, base: clod.Checkpoint) -> None:
    """The rows that the reader used, without MaskGaussian's columns, whose averages would mean nothing."""
    names = [name for name in base.vertex.dtype.names if not name.startswith("masks_")]
    plain = base.vertex[names].astype([(name, base.vertex.dtype[name]) for name in names])  # a view keeps the gaps
    PlyData([PlyElement.describe(plain, "vertex")]).write(path)
