"""The origin of a scene far from 0: coordinates relative to it fit float32."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

Origin = tuple[float, float, float]
NOWHERE: Origin = (0.0, 0.0, 0.0)
# Times the spread of the scene. Closer to 0, float32 resolves 1e-5 of the spread, and the origin
# stays 0.
FAR = 100.0
SAMPLE = 1 << 18  # rows that it is found from, evenly spread
FINEST = 2.0**-40  # of the distance from 0: the finest unit that an origin is rounded to


def origin_of(means: np.ndarray) -> Origin:
    """The origin for the coordinates ``[N, 3]``, world units: the median, or 0 unless the scene is
    far from 0.

    Rounded to a power of two near the spread (the middle 80 % along the widest axis): subtracting
    it is exact then.
    """
    import numpy as np  # here: --help needs none

    with np.errstate(over="ignore", invalid="ignore"):  # doubles, signalling NaN
        sample = means[:: len(means) // SAMPLE + 1].astype(np.float64)
        sample = sample[np.isfinite(sample).all(1)]
        if not len(sample):
            return NOWHERE
        low, middle, high = np.quantile(sample, (0.1, 0.5, 0.9), axis=0, method="nearest")
        spread = float((high - low).max())
    distance = float(np.abs(middle).max())
    if not 0 < FAR * spread < distance:
        return NOWHERE
    # The spread of doubles may be below the precision of the largest.
    unit = 2.0 ** math.ceil(math.log2(max(spread, FINEST * distance)))
    x, y, z = (np.round(middle / unit) * unit + 0.0).tolist()  # no -0
    return x, y, z


def parse_origin(values: Any) -> Origin:
    """The origin from three stored numbers; raises TypeError or ValueError if they are not three
    finite numbers.
    """
    x, y, z = map(float, values)
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"origin is {values!r:.80}, not finite")
    return x, y, z


def relative(means: np.ndarray, at: Sequence[float], origin: Sequence[float]) -> np.ndarray:
    """``[N, 3]`` float32: coordinates that are relative to ``at``, relative to ``origin``."""
    import numpy as np  # here: --help needs none

    with np.errstate(over="ignore", invalid="ignore"):
        if tuple(at) == tuple(origin):
            return means.astype(np.float32, copy=False)
        return (means.astype(np.float64) + at - origin).astype(np.float32)
