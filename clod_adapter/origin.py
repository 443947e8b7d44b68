"""The origin of a scene far from 0: coordinates relative to it fit float32."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

Origin = tuple[float, float, float]
NOWHERE: Origin = (0.0, 0.0, 0.0)
AXES = ("x", "y", "z")
# Times the spread of the scene. Closer to 0, float32 resolves 1e-5 of the spread, and the origin stays 0.
FAR = 100.0
FINEST = 2.0**-40  # of the distance from 0: the finest unit that an origin is rounded to


def origin_of(vertex: np.ndarray) -> Origin:
    """The origin for the coordinates ``x, y, z`` of the rows, world units; 0 unless the scene is far from 0.

    The median, rounded to multiples of a power of two near the spread (the middle 80 % along the widest axis), so that
    subtracting it from float32 coordinates is exact.
    """
    with np.errstate(invalid="ignore"):  # signalling NaN
        xyz = np.stack([vertex[axis].astype(np.float64) for axis in AXES], 1)
    xyz = xyz[np.isfinite(xyz).all(1)]
    if not len(xyz):
        return NOWHERE
    low, middle, high = np.quantile(xyz, (0.1, 0.5, 0.9), axis=0, method="nearest")
    with np.errstate(over="ignore"):  # of doubles
        spread = float((high - low).max())
    if not 0 < FAR * spread < float(np.abs(middle).max()):
        return NOWHERE
    # The spread of doubles may be below the precision of the largest.
    unit = 2.0 ** math.ceil(math.log2(max(spread, FINEST * float(np.abs(middle).max()))))
    x, y, z = (float(value) for value in np.round(middle / unit) * unit + 0.0)  # no -0
    return x, y, z


def parse_origin(values: Any) -> Origin:
    """The origin from three stored numbers; raises TypeError or ValueError if they are not three finite numbers."""
    x, y, z = map(float, values)
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"origin is {values!r:.80}, not finite")
    return x, y, z


def relative(vertex: np.ndarray, origin: Sequence[float]) -> np.ndarray:
    """``[N, 3]`` float32 coordinates of the rows relative to ``origin``."""
    with np.errstate(over="ignore", invalid="ignore"):
        columns = [vertex[axis].astype(np.float64) - by for axis, by in zip(AXES, origin, strict=True)]
        return np.stack(columns, 1).astype(np.float32)
