"""Merging without training: ``splat-transform --decimate`` (NanoGS's pairwise merging), with a cache of its files."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import clod_adapter as clod
from clod_adapter.io.formats.splat_transform import SplatTransform
from common import CACHE

from plyfile import PlyData, PlyElement

TIMEOUT = 3600.0  # seconds


def find_tool() -> SplatTransform:
    """splat-transform without a GPU; exits with the install command where it is missing or too old."""
    try:
        return replace(SplatTransform.find(), gpu=False)
    except clod.ClodError as error:
        sys.exit(str(error))


def merge(base: clod.Checkpoint, count: int) -> tuple[clod.Gaussians, float]:
    """The base merged to ``count`` Gaussians, and the seconds that the tool took, then or now."""
    tool = find_tool()
    CACHE.mkdir(parents=True, exist_ok=True)
    out = CACHE / f"{base.fingerprint[:12]}-{tool.version}-{count}.ply"
    clock = out.with_suffix(".seconds")
    if not (out.exists() and clock.exists()):
        # In a folder of its own: another benchmark may want the same file now.
        with tempfile.TemporaryDirectory(dir=CACHE) as folder:
            source, merged = Path(folder) / "base.ply", Path(folder) / "merged.ply"
            _write_plain(source, base)
            try:
                seconds = tool.run("-q", source, "--decimate", str(count), merged, timeout=TIMEOUT)
            except clod.ClodError as error:
                sys.exit(str(error))
            clock.write_text(f"{seconds:.2f}\n", encoding="utf-8")
            merged.replace(out)
    return clod.load(out).gaussians, float(clock.read_text(encoding="utf-8"))


def _write_plain(path: Path, base: clod.Checkpoint) -> None:
    """The rows that the reader used, without MaskGaussian's columns, whose averages would mean nothing."""
    names = [name for name in base.vertex.dtype.names if not name.startswith("masks_")]
    plain = base.vertex[names].astype([(name, base.vertex.dtype[name]) for name in names])  # a view keeps the gaps
    PlyData([PlyElement.describe(plain, "vertex")]).write(path)
