"""Accuracy of the elementary functions, against numpy in float64."""

from __future__ import annotations

import numpy as np
from numba import njit

from clod_adapter._kernels.elementary import exp2, log2
from clod_adapter._kernels.simd import load, store

LANES = 16


@njit
def elementary(function, x, out):
    for at in range(0, len(x), LANES):
        store(out, at, exp2(load(x, at)) if function == 0 else log2(load(x, at)))


def exp2_of(x: np.ndarray) -> np.ndarray:
    padded = np.resize(x, -(-len(x) // LANES) * LANES)
    out = np.empty_like(padded)
    elementary(0, padded, out)
    return out[: len(x)]


def log2_of(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The logarithms, and those of numpy in float64, of ``x`` cut to whole vectors."""
    x = np.resize(x, -(-len(x) // LANES) * LANES)
    found = np.empty_like(x)
    elementary(1, x, found)
    return found, np.log2(x.astype(np.float64))


def test_exp2_has_a_relative_error_below_3e_7() -> None:
    """Two to three units in the last place, over what blending needs, [-126, 0], and above."""
    below = np.concatenate([np.linspace(-126, 0, 1_000_001), -np.logspace(-30, 2.1, 100_001)]).astype(np.float32)
    for x in (below[below >= -126], np.linspace(0, 127, 100_001).astype(np.float32)):
        want = np.exp2(x.astype(np.float64))
        assert (np.abs(exp2_of(x) - want) / want).max() < 3e-7


def test_log2_has_an_absolute_error_below_1e_7() -> None:
    """In addition to one and a half units of the result (tests/other_libm); for every fifth mantissa of two octaves and
    all normal exponents."""
    octaves = np.float32(0.5).view(np.uint32) + np.arange(0, 1 << 24, 5, dtype=np.uint32)
    every = np.arange(0x00800000, np.float32(3.4e38).view(np.uint32), 997, dtype=np.uint32)
    ends = np.array([2.0**-126, 3e38, np.finfo(np.float32).max], np.float32)
    for x in (octaves.view(np.float32), np.concatenate([ends, every.view(np.float32)])):
        found, want = log2_of(x)
        rounding = np.spacing(np.abs(want).astype(np.float32)) * 1.5
        assert (np.abs(found - want) - rounding).max() < 1e-7
