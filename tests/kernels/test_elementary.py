"""Accuracy of the elementary functions, against numpy in float64."""

import numpy as np
from numba import njit

from clod_adapter._kernels.elementary import exp2, log2
from clod_adapter._kernels.simd import load, store


@njit
def elementary(function, x, out):
    for at in range(0, len(x), 16):
        store(out, at, exp2(load(x, at)) if function == 0 else log2(load(x, at)))


def both(function: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of ``x``, repeated to whole vectors: the function's results, and numpy's in float64."""
    x = np.resize(x, -(-len(x) // 16) * 16)
    out = np.empty_like(x)
    elementary(function, x, out)
    return out, (np.exp2, np.log2)[function](x.astype(np.float64))


def test_exp2_has_a_relative_error_below_3e_7() -> None:
    """Two to three units in the last place, over what blending needs, [-126, 0], and above."""
    some = np.concatenate([np.linspace(-126, 127, 1_000_001), -np.logspace(-30, 2.1, 100_001)]).astype(np.float32)
    found, want = both(0, some[some >= -126])
    assert (np.abs(found - want) / want).max() < 3e-7


def test_log2_has_an_absolute_error_below_1e_7() -> None:
    """In addition to one and a half units of the result (tests/other_libm); for every fifth mantissa of two octaves and
    all normal exponents."""
    octaves = np.float32(0.5).view(np.uint32) + np.arange(0, 1 << 24, 5, dtype=np.uint32)
    every = np.arange(0x00800000, np.float32(3.4e38).view(np.uint32), 997, dtype=np.uint32)
    found, want = both(1, np.concatenate([octaves, every]).view(np.float32))
    rounding = np.spacing(np.abs(want).astype(np.float32)) * 1.5
    assert (np.abs(found - want) - rounding).max() < 1e-7
