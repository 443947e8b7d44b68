"""Packs a splat for a standalone page with splat-transform: SOG, a fifth of the PLY's size, and the dial's columns
separately.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load
from clod_adapter.io.formats.splat_transform import SplatTransform, time_limit
from clod_adapter.viewer.payload import Payload, dial_of

BITS = 11  # stored fraction bits of the dial's columns; their relative error is at most 2^-12


@dataclass(frozen=True)
class PackedSplat:
    """A packed splat.

    Attributes:
        sog: the .sog file.
        columns: ``payload.dial_of``: each as gzip of ``[N]`` little-endian float32 in the row order of ``sog``.
    """

    sog: bytes
    columns: dict[str, bytes]


def pack_sog(
    payload: Payload, tool: SplatTransform, folder: Path, progress: Callable[[float], None] | None = None
) -> PackedSplat:
    """Packs a splat.

    SOG has no field for the dial's columns and sorts the rows in Morton order. So a PLY, which keeps all columns, is
    sorted first; sorting it again does not change the order.

    Args:
        folder: absolute, with space for three PLYs in a temporary folder.
        progress: called at intervals with the seconds that the current step has taken.

    Raises:
        ClodError: splat-transform fails, takes too long, or removes Gaussians.
    """
    count = len(payload.gaussians)
    timeout = time_limit(count)
    with TemporaryDirectory(dir=folder, prefix=".tmp-") as temporary:
        rows, ordered, sog = (Path(temporary) / name for name in ("rows.ply", "ordered.ply", "packed.sog"))
        with open(rows, "wb") as file:
            file.writelines(payload.blocks())
        tool.run(rows, ordered, "-m", timeout=timeout, progress=progress)
        tool.run(ordered, sog, timeout=timeout, progress=progress)
        found = load(ordered, activated="none").gaussians
        if len(found) != count:
            raise ClodError(
                f"splat-transform {tool.version} has written {len(found)} of {count} Gaussians; try another version"
            )
        columns = {name: _rounded(value.numpy()).tobytes() for name, value in dial_of(found).items()}
        return PackedSplat(sog.read_bytes(), {name: gzip.compress(data) for name, data in columns.items()})


def _rounded(values: np.ndarray) -> np.ndarray:
    """float32 rounded to BITS fraction bits, for compression by gzip."""
    step = np.uint32(1 << (23 - BITS))
    up = values.astype("<f4").view("<u4") + (step >> np.uint32(1))
    return (up & ~(step - np.uint32(1))).view("<f4")
