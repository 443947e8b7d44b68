"""A splat for a page to send to somebody: SOG, a fifth of the PLY's size, and sigma_d beside it, by splat-transform."""

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
from clod_adapter.viewer.payload import Payload

BITS = 11  # of a sigma_d's fraction that are kept; it is off by at most 2^-12 of itself


@dataclass(frozen=True)
class Packed:
    """A splat as a page holds it.

    Attributes:
        sog: the .sog file.
        sigma: gzip of ``[N]`` little-endian float32 sigma_d in the order of its rows; None without a dial.
    """

    sog: bytes
    sigma: bytes | None


def pack(
    payload: Payload, tool: SplatTransform, folder: Path, progress: Callable[[float], None] | None = None
) -> Packed:
    """Packs a splat.

    SOG has no room for sigma_d and puts the rows in Morton order. So they are put in that order first, as a PLY, which
    keeps all columns; of one that is in it already the order stays.

    Args:
        folder: an absolute one that has room for three PLYs of it, in a folder there that is removed.
        progress: called now and then with the seconds that a part has taken so far.

    Raises:
        ClodError: splat-transform fails, takes too long, or loses Gaussians.
    """
    count = len(payload.gaussians)
    timeout = time_limit(count)
    with TemporaryDirectory(dir=folder, prefix=".tmp-") as made:
        rows, ordered, sog = (Path(made) / name for name in ("rows.ply", "ordered.ply", "packed.sog"))
        with open(rows, "wb") as file:
            file.writelines(payload.blocks())
        tool.run(rows, ordered, "-m", timeout=timeout, progress=progress)
        tool.run(ordered, sog, timeout=timeout, progress=progress)
        found = load(ordered, activated="none").gaussians
        if len(found) != count:
            raise ClodError(f"splat-transform {tool.version} has kept {len(found)} of {count} Gaussians")
        sigma = None if found.sigma_d is None else gzip.compress(_rounded(found.sigma_d.numpy()).tobytes())
        return Packed(sog.read_bytes(), sigma)


def _rounded(values: np.ndarray) -> np.ndarray:
    """float32 with the last bits 0, which gzip takes the room of: to the nearest, as far as there is one."""
    step = np.uint32(1 << (23 - BITS))
    up = values.astype("<f4").view("<u4") + (step >> np.uint32(1))
    return (up & ~(step - np.uint32(1))).view("<f4")
