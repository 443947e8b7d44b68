"""Colours of Gaussians: spherical harmonics in the viewing direction, sixteen Gaussians at a time."""

from __future__ import annotations

from numba import int64, uint64

from clod_adapter._kernels.bits import bits_of
from clod_adapter._kernels.compiling import part
from clod_adapter._kernels.conventions import EYE, HALF, HUGE, MEAN, ONE, RECORD, RED, ZERO
from clod_adapter._kernels.elementary import vabs, vsqrt
from clod_adapter._kernels.pointers import scratch
from clod_adapter._kernels.rows import load_rows, store_rows
from clod_adapter._kernels.sh import sh_basis
from clod_adapter._kernels.simd import f32x16, fma, gt, splat, vmax


@part
def view_direction(w, cam, out):  # type: ignore[no-untyped-def]
    """Unit directions from the camera to the Gaussians into ``out[:3]``; returns 1 / distance."""
    x, y, z = w[MEAN] - cam[EYE], w[MEAN + 1] - cam[EYE + 1], w[MEAN + 2] - cam[EYE + 2]
    inverse = ONE / vsqrt(x * x + y * y + z * z)
    out[0], out[1], out[2] = x * inverse, y * inverse, z * inverse
    return inverse


@part
def load_sh(shN, rows, terms, w):  # type: ignore[no-untyped-def]
    """Loads the ``terms`` harmonics above degree 0 of sixteen rows, three channels each, into ``w``."""
    for first in range(0, 3 * terms, 16):
        load_rows(shN, rows, 3 * terms, first, min(3 * terms - first, 16), w, first)


@part
def color(first, found, means, sh0, shN, degree, cam, records, depths, ids):  # type: ignore[no-untyped-def]
    """Writes the colours ``max(0, 0.5 + SH)`` of the packed records; returns how many remain: only finite ones."""
    w, sh, basis = scratch(f32x16, 16), scratch(f32x16, 80), scratch(f32x16, 25)
    rows, targets = scratch(int64, 16), scratch(int64, 16)
    terms = (degree + 1) * (degree + 1) - 1
    packed = first
    for start in range(first, first + found, 16):
        for lane in range(16):
            targets[lane] = min(start + lane, first + found - 1)
            rows[lane] = ids[targets[lane]]
        load_rows(means, rows, 3, 0, 3, w, MEAN)
        view_direction(w, cam, sh)
        sh_basis(degree, sh[0], sh[1], sh[2], basis)
        load_rows(sh0, rows, 3, 0, 3, w, 0)
        load_sh(shN, rows, terms, sh)
        red, green, blue = HALF + basis[0] * w[0], HALF + basis[0] * w[1], HALF + basis[0] * w[2]
        for k in range(terms):
            red, green = fma(basis[k + 1], sh[3 * k], red), fma(basis[k + 1], sh[3 * k + 1], green)
            blue = fma(basis[k + 1], sh[3 * k + 2], blue)
        finite = gt(splat(HUGE), vabs(red) + vabs(green) + vabs(blue))
        w[0], w[1], w[2] = vmax(red, splat(ZERO)), vmax(green, splat(ZERO)), vmax(blue, splat(ZERO))
        store_rows(records, targets, RECORD, RED, 3, w, 0)
        bits = bits_of(finite)
        for lane in range(16):
            at = start + lane
            if at < first + found and (bits >> uint64(lane)) & uint64(1):
                if packed < at:
                    depths[packed], ids[packed] = depths[at], ids[at]
                    for k in range(RECORD):
                        records[packed * RECORD + k] = records[at * RECORD + k]
                packed += 1
    return packed - first
