"""Colours: real spherical harmonics up to degree 3, in the order and signs of 3DGS, of sixteen
Gaussians at a time.
"""

from numba import float32, int64, uint64

from clod_adapter._kernels.compiling import inlined
from clod_adapter._kernels.conventions import HUGE, MEAN, RECORD, RED
from clod_adapter._kernels.dial import squared_distance
from clod_adapter._kernels.elementary import bits_of, vabs, vsqrt
from clod_adapter._kernels.pointers import load_rows, scratch, store_rows
from clod_adapter._kernels.simd import f32x16, fma, gt, splat, vmax

C0 = float32(0.28209479177387814)
C1 = float32(0.4886025119029199)
C20 = float32(1.0925484305920792)
C22 = float32(0.31539156525252005)
C24 = float32(0.5462742152960396)
C30 = float32(-0.5900435899266435)
C31 = float32(2.890611442640554)
C32 = float32(-0.4570457994644658)
C33 = float32(0.3731763325901154)
C35 = float32(1.445305721320277)


@inlined
def sh_basis(degree, x, y, z, out):
    """Values of the (degree + 1)^2 basis functions in the unit direction (x, y, z)."""
    out[0] = splat(C0)
    if degree < 1:
        return
    out[1] = -C1 * y
    out[2] = C1 * z
    out[3] = -C1 * x
    if degree < 2:
        return
    xx = x * x
    yy = y * y
    zz = z * z
    xy = x * y
    yz = y * z
    xz = x * z
    out[4] = C20 * xy
    out[5] = -C20 * yz
    out[7] = -C20 * xz
    out[6] = C22 * (2 * zz - xx - yy)
    out[8] = C24 * (xx - yy)
    if degree < 3:
        return
    four = 4 * zz - xx - yy
    out[9] = C30 * y * (3 * xx - yy)
    out[10] = C31 * xy * z
    out[11] = C32 * y * four
    out[12] = C33 * z * (2 * zz - 3 * xx - 3 * yy)
    out[13] = C32 * x * four
    out[14] = C35 * z * (xx - yy)
    out[15] = C30 * x * (xx - 3 * yy)


@inlined
def sh_basis_gradient(degree, x, y, z, v):
    """Gradient of ``sum_k v[k] * basis_k`` with respect to (x, y, z) as free variables."""
    gx = gy = gz = splat(0)
    if degree >= 1:
        gx = -C1 * v[3]
        gy = -C1 * v[1]
        gz = C1 * v[2]
    if degree >= 2:
        gx += C20 * (y * v[4] - z * v[7]) - 2 * C22 * x * v[6] + 2 * C24 * x * v[8]
        gy += C20 * (x * v[4] - z * v[5]) - 2 * C22 * y * v[6] - 2 * C24 * y * v[8]
        gz += C20 * (-y * v[5] - x * v[7]) + 4 * C22 * z * v[6]
    if degree >= 3:
        xx = x * x
        yy = y * y
        zz = z * z
        xy = x * y
        yz = y * z
        xz = x * z
        gx += 6 * C30 * xy * v[9] + C31 * yz * v[10] - 2 * C32 * xy * v[11] - 6 * C33 * xz * v[12]
        gx += (
            C32 * (4 * zz - 3 * xx - yy) * v[13]
            + 2 * C35 * xz * v[14]
            + 3 * C30 * (xx - yy) * v[15]
        )
        gy += 3 * C30 * (xx - yy) * v[9] + C31 * xz * v[10] + C32 * (4 * zz - xx - 3 * yy) * v[11]
        gy += (
            -6 * C33 * yz * v[12]
            - 2 * C32 * xy * v[13]
            - 2 * C35 * yz * v[14]
            - 6 * C30 * xy * v[15]
        )
        gz += C31 * xy * v[10] + 8 * C32 * yz * v[11] + 3 * C33 * (2 * zz - xx - yy) * v[12]
        gz += 8 * C32 * xz * v[13] + C35 * (xx - yy) * v[14]
    return gx, gy, gz


@inlined
def view_direction(w, drawing, out):
    """Unit directions from the camera to the Gaussians into ``out[:3]``; returns 1 / distance."""
    inverse = 1 / vsqrt(squared_distance(w, drawing))
    for k in range(3):
        out[k] = (w[MEAN + k] - drawing.eye[k]) * inverse
    return inverse


@inlined
def load_sh(shN, rows, terms, w):
    """Loads the ``terms`` harmonics above degree 0 of sixteen rows, three channels each, into
    ``w``.
    """
    for first in range(0, 3 * terms, 16):
        load_rows(shN, rows, 3 * terms, first, min(3 * terms - first, 16), w, first)


@inlined
def color(first, count, stored, drawing, packed):
    """Writes the colours ``max(0, 0.5 + SH)`` of ``count`` packed records from ``first`` on;
    returns how many remain: only finite ones.
    """
    records = packed.records
    depths = packed.depths
    ids = packed.ids
    w = scratch(f32x16, 16)
    sh = scratch(f32x16, 48)
    basis = scratch(f32x16, 16)
    rows = scratch(int64, 16)
    targets = scratch(int64, 16)
    terms = (drawing.degree + 1) * (drawing.degree + 1) - 1
    end = first + count
    kept = first
    for start in range(first, end, 16):
        for lane in range(16):
            targets[lane] = min(start + lane, end - 1)
            rows[lane] = ids[targets[lane]]
        load_rows(stored.means, rows, 3, 0, 3, w, MEAN)
        view_direction(w, drawing, sh)
        sh_basis(drawing.degree, sh[0], sh[1], sh[2], basis)
        load_rows(stored.sh0, rows, 3, 0, 3, w, 0)
        load_sh(stored.shN, rows, terms, sh)
        total = splat(0)
        for channel in range(3):
            value = 0.5 + basis[0] * w[channel]
            for k in range(terms):
                value = fma(basis[k + 1], sh[3 * k + channel], value)
            total += vabs(value)
            w[channel] = vmax(value, 0)
        finite = bits_of(gt(HUGE, total))
        store_rows(records, targets, RECORD, RED, 3, w, 0)
        for at in range(start, min(start + 16, end)):
            if (finite >> uint64(at - start)) & uint64(1):
                if kept < at:
                    depths[kept] = depths[at]
                    ids[kept] = ids[at]
                    for k in range(RECORD):
                        records[kept * RECORD + k] = records[at * RECORD + k]
                kept += 1
    return kept - first
