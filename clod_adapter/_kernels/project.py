"""Projection of Gaussians to the image: the local affine approximation (EWA splatting).

Conventions of gsplat: pixel centres at +0.5, the filter's variance added to the covariance and, with ``compensate``,
the opacity compensated for it; the Jacobian's ray clamped to 1.3 times the field of view (0.3 beyond the image on
either side), the camera's near plane, alpha below 1/255 dropped. Sixteen Gaussians at a time, one per lane.
"""

from __future__ import annotations

from numba import float32, float64, int64, uint64

from clod_adapter._kernels.bits import bits_of
from clod_adapter._kernels.colors import color
from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.conventions import (
    ALPHA_MIN,
    BLUE,
    BLUR,
    COMPENSATE,
    COV,
    COVDET,
    CX,
    CY,
    DET,
    FX,
    FY,
    GREEN,
    HALF,
    HEIGHT,
    HIGH_X,
    HIGH_Y,
    HUGE,
    LOG,
    LOG2_255,
    LOG2E,
    LOW_X,
    LOW_Y,
    MEAN,
    MX,
    MY,
    NEAR,
    ONE,
    PMAT,
    POINT,
    QA,
    QB,
    QC,
    QINV,
    QUAT,
    QUAT_MAX2,
    QUAT_MIN2,
    RAWDET,
    REACH,
    RECORD,
    RED,
    ROT,
    RX,
    SCALE,
    SLACK,
    STORED,
    TWO,
    TWO_LN2,
    UMAT,
    WIDTH,
    WORKSPACE,
    X0,
    X1,
    Y0,
    Y1,
    ZERO,
)
from clod_adapter._kernels.elementary import log2, vceil, vfloor, vsqrt
from clod_adapter._kernels.pointers import pointer, scratch
from clod_adapter._kernels.rows import load_rows, store_rows
from clod_adapter._kernels.simd import both, f32x16, ge, gt, load, splat, vmax, vmin


@part
def load_stored(means, quats, scales, rows, w):  # type: ignore[no-untyped-def]
    """Loads what is stored of sixteen rows into the workspace ``w``."""
    load_rows(means, rows, 3, 0, 3, w, MEAN)
    load_rows(quats, rows, 4, 0, 4, w, STORED)
    load_rows(scales, rows, 3, 0, 3, w, SCALE)


@part
def covariance(cam, w):  # type: ignore[no-untyped-def]
    """Fills the rest of the workspace ``w``; returns which are in front of the near plane and have a rotation."""
    for d in range(3):
        row = 4 * d
        w[POINT + d] = cam[row] * w[MEAN] + cam[row + 1] * w[MEAN + 1] + cam[row + 2] * w[MEAN + 2] + cam[row + 3]
    norm2 = w[STORED] * w[STORED] + w[STORED + 1] * w[STORED + 1]
    norm2 = norm2 + w[STORED + 2] * w[STORED + 2] + w[STORED + 3] * w[STORED + 3]
    valid = both(ge(norm2, splat(QUAT_MIN2)), ge(splat(QUAT_MAX2), norm2))
    valid = both(ge(w[POINT + 2], splat(cam[NEAR])), valid)
    w[QINV] = ONE / vsqrt(norm2)
    for d in range(4):
        w[QUAT + d] = w[STORED + d] * w[QINV]
    rotation(w)
    iz = ONE / w[POINT + 2]
    rx = vmin(vmax(w[POINT] * iz, splat(cam[LOW_X])), splat(cam[HIGH_X]))
    ry = vmin(vmax(w[POINT + 1] * iz, splat(cam[LOW_Y])), splat(cam[HIGH_Y]))
    for k in range(3):
        w[UMAT + k] = cam[FX] * iz * (splat(cam[k]) - rx * cam[8 + k])
        w[UMAT + 3 + k] = cam[FY] * iz * (splat(cam[4 + k]) - ry * cam[8 + k])
    for row in range(2):
        u = UMAT + 3 * row
        for k in range(3):
            along = w[u] * w[ROT + k] + w[u + 1] * w[ROT + 3 + k] + w[u + 2] * w[ROT + 6 + k]
            w[PMAT + 3 * row + k] = along * w[SCALE + k]
    finish_covariance(w, cam)
    return both(valid, gt(splat(HUGE), w[COVDET]))


@part
def rotation(w):  # type: ignore[no-untyped-def]
    """Rotation matrix, row-major, of the unit quaternion."""
    q0, q1, q2, q3 = w[QUAT], w[QUAT + 1], w[QUAT + 2], w[QUAT + 3]
    w[ROT] = ONE - TWO * (q2 * q2 + q3 * q3)
    w[ROT + 1] = TWO * (q1 * q2 - q0 * q3)
    w[ROT + 2] = TWO * (q1 * q3 + q0 * q2)
    w[ROT + 3] = TWO * (q1 * q2 + q0 * q3)
    w[ROT + 4] = ONE - TWO * (q1 * q1 + q3 * q3)
    w[ROT + 5] = TWO * (q2 * q3 - q0 * q1)
    w[ROT + 6] = TWO * (q1 * q3 - q0 * q2)
    w[ROT + 7] = TWO * (q2 * q3 + q0 * q1)
    w[ROT + 8] = ONE - TWO * (q1 * q1 + q2 * q2)


@part
def finish_covariance(w, cam):  # type: ignore[no-untyped-def]
    """Covariance ``P P^T + blur``, and determinants with and without blur as sums of squares, exact for needles."""
    blur = cam[BLUR]
    p0, p1, p2, p3, p4, p5 = w[PMAT], w[PMAT + 1], w[PMAT + 2], w[PMAT + 3], w[PMAT + 4], w[PMAT + 5]
    xx, yy = p0 * p0 + p1 * p1 + p2 * p2, p3 * p3 + p4 * p4 + p5 * p5
    w[COV], w[COV + 1], w[COV + 2] = xx + blur, p0 * p3 + p1 * p4 + p2 * p5, yy + blur
    cx, cy, cz = p1 * p5 - p2 * p4, p2 * p3 - p0 * p5, p0 * p4 - p1 * p3
    w[RAWDET] = cx * cx + cy * cy + cz * cz
    w[COVDET] = w[RAWDET] + blur * (xx + yy) + blur * blur


@part
def centres(means, rows, cam, out):  # type: ignore[no-untyped-def]
    """Sixteen centres on the image, x then y in pixels, and their depths, into ``out [48]``.

    In float64: at the edge of a picture 960 wide a float32 centre is off by 1e-4 pixels, and alpha by as much.
    """
    for lane in range(16):
        at = 3 * rows[lane]
        x, y, z = float64(means[at]), float64(means[at + 1]), float64(means[at + 2])
        depth = cam[8] * x + cam[9] * y + cam[10] * z + cam[11]
        inverse = float64(1) / depth
        out[lane] = cam[FX] * (cam[0] * x + cam[1] * y + cam[2] * z + cam[3]) * inverse + cam[CX]
        out[16 + lane] = cam[FY] * (cam[4] * x + cam[5] * y + cam[6] * z + cam[7]) * inverse + cam[CY]
        out[32 + lane] = depth


@part
def make_records(w, centre, opacity, cam, record):  # type: ignore[no-untyped-def]
    """Fills the sixteen columns of the records except the colours; returns which of them reach a pixel centre."""
    mx, my = load(centre, 0), load(centre, 16)
    idet = ONE / w[COVDET]
    record[MX], record[MY] = mx, my
    record[QA], record[QC] = HALF * LOG2E * w[COV + 2] * idet, HALF * LOG2E * w[COV] * idet
    record[QB], record[DET] = -(LOG2E * w[COV + 1] * idet), LOG2E * LOG2E * idet
    if cam[COMPENSATE] > ZERO:  # NaN for an infinite covariance, which is not drawn
        opacity = opacity * vsqrt(w[RAWDET] * idet)
    drawn = ge(opacity, splat(ALPHA_MIN))
    record[LOG] = log2(opacity)
    record[RED] = record[GREEN] = record[BLUE] = splat(ZERO)
    reach = vmax(record[LOG] + LOG2_255, splat(ZERO))
    rx, ry = vsqrt(TWO_LN2 * reach * w[COV]), vsqrt(TWO_LN2 * reach * w[COV + 2])
    record[REACH], record[RX] = reach, rx
    record[X0] = vmax(vceil(mx - rx - HALF - SLACK), splat(ZERO))
    record[X1] = vmin(vfloor(mx + rx - HALF + SLACK), splat(cam[WIDTH] - ONE))
    record[Y0] = vmax(vceil(my - ry - HALF - SLACK), splat(ZERO))
    record[Y1] = vmin(vfloor(my + ry - HALF + SLACK), splat(cam[HEIGHT] - ONE))
    return both(drawn, both(ge(record[X1], record[X0]), ge(record[Y1], record[Y0])))


@part
def add_records(rows, filled, packed, spare, means, opacity, cam, w, records, depths, ids):  # type: ignore[no-untyped-def]
    """Packs those of the first ``filled`` of sixteen ``rows`` that reach a pixel centre, from the record ``packed`` on.

    ``w`` holds what is stored of the rows. Returns the number of the next record.
    """
    record, centre, targets = scratch(f32x16, RECORD), scratch(float32, 48), scratch(int64, 16)
    valid = covariance(cam, w)
    centres(means, rows, cam, centre)
    valid = both(valid, ge(load(centre, 32), splat(cam[NEAR])))  # in float32 too, not only in float64
    bits = bits_of(both(valid, make_records(w, centre, opacity, cam, record)))
    bits &= (uint64(1) << uint64(filled)) - uint64(1)
    if bits == uint64(0):
        return packed
    for lane in range(16):
        targets[lane] = spare
        if (bits >> uint64(lane)) & uint64(1):
            depths[packed], ids[packed], targets[lane] = centre[32 + lane], rows[lane], packed
            packed += 1
    store_rows(records, targets, RECORD, 0, RECORD, record, 0)
    return packed


@kernel
def project(worker, workers, means, quats, scales, opacities, sh0, shN, degree, cam, records, depths, ids, counts):  # type: ignore[no-untyped-def]
    """Writes records, depths and row numbers of this worker's visible Gaussians, packed from its first row.

    After its N records, ``records`` has a spare one for each worker.
    """
    spare = len(opacities) + worker
    first, last = len(opacities) * worker // workers, len(opacities) * (worker + 1) // workers
    means, quats, scales, opacities = pointer(means), pointer(quats), pointer(scales), pointer(opacities)
    sh0, shN, cam, records = pointer(sh0), pointer(shN), pointer(cam), pointer(records)
    depths, ids = pointer(depths), pointer(ids)
    found = find_visible(first, last, spare, means, quats, scales, opacities, cam, records, depths, ids)
    counts[worker] = color(first, found, means, sh0, shN, degree, cam, records, depths, ids)


@part
def find_visible(first, last, spare, means, quats, scales, opacities, cam, records, depths, ids):  # type: ignore[no-untyped-def]
    """Packs the Gaussians that reach a pixel centre, from ``first`` on; returns how many there are."""
    w, opacity, rows = scratch(f32x16, WORKSPACE), scratch(float32, 16), scratch(int64, 16)
    i = packed = first
    while i < last:
        filled = 0
        while i < last and filled < 16:
            rows[filled], opacity[filled] = i, opacities[i]
            filled += opacities[i] >= ALPHA_MIN and opacities[i] < HUGE  # else the next row takes its place
            i += 1
        for lane in range(filled, 16):
            rows[lane], opacity[lane] = rows[0], ONE
        load_stored(means, quats, scales, rows, w)
        packed = add_records(rows, filled, packed, spare, means, load(opacity, 0), cam, w, records, depths, ids)
    return packed - first
