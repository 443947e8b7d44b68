"""Projection of Gaussians to the image: the local affine approximation (EWA splatting).

Conventions of gsplat: pixel centres at +0.5, a blur of 0.3 px^2 added to the covariance, the
Jacobian's ray clamped to 1.3 times the field of view (0.3 beyond the image on either side), near
plane 0.01, alpha below 1/255 dropped.
"""

from __future__ import annotations

import math

from numba import float32

from clod_adapter._kernels.compiling import kernel, part, pointer, scratch
from clod_adapter._kernels.conventions import (
    ALPHA_MIN,
    BLUR,
    COV,
    COVDET,
    CX,
    CY,
    DET,
    EYE,
    FX,
    FY,
    HALF,
    HEIGHT,
    HIGH_X,
    HIGH_Y,
    LOG,
    LOG2_255,
    LOG2E,
    LOW_X,
    LOW_Y,
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
    REACH,
    RECORD,
    RED,
    ROT,
    RX,
    SCRATCH,
    SLACK,
    TWO,
    TWO_LN2,
    UMAT,
    WIDTH,
    X0,
    X1,
    Y0,
    Y1,
    ZERO,
)
from clod_adapter._kernels.sh import sh_basis


@part
def covariance(means, quats, scales, i, cam, w):  # type: ignore[no-untyped-def]
    """Fills the workspace ``w``; False if the Gaussian is behind the near plane or has no rotation."""
    mx, my, mz = means[3 * i], means[3 * i + 1], means[3 * i + 2]
    for d in range(3):
        w[POINT + d] = cam[4 * d] * mx + cam[4 * d + 1] * my + cam[4 * d + 2] * mz + cam[4 * d + 3]
    z = w[POINT + 2]
    q0, q1, q2, q3 = quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]
    norm2 = q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3
    if not (z >= NEAR and norm2 > ZERO):
        return False
    inverse = ONE / math.sqrt(norm2)
    w[QINV] = inverse
    q0, q1, q2, q3 = q0 * inverse, q1 * inverse, q2 * inverse, q3 * inverse
    w[QUAT], w[QUAT + 1], w[QUAT + 2], w[QUAT + 3] = q0, q1, q2, q3
    w[ROT], w[ROT + 1], w[ROT + 2] = (
        ONE - TWO * (q2 * q2 + q3 * q3),
        TWO * (q1 * q2 - q0 * q3),
        TWO * (q1 * q3 + q0 * q2),
    )
    w[ROT + 3], w[ROT + 4], w[ROT + 5] = (
        TWO * (q1 * q2 + q0 * q3),
        ONE - TWO * (q1 * q1 + q3 * q3),
        TWO * (q2 * q3 - q0 * q1),
    )
    w[ROT + 6], w[ROT + 7], w[ROT + 8] = (
        TWO * (q1 * q3 - q0 * q2),
        TWO * (q2 * q3 + q0 * q1),
        ONE - TWO * (q1 * q1 + q2 * q2),
    )
    iz = ONE / z
    rx = min(max(w[POINT] * iz, cam[LOW_X]), cam[HIGH_X])
    ry = min(max(w[POINT + 1] * iz, cam[LOW_Y]), cam[HIGH_Y])
    jx, jy = cam[FX] * iz, cam[FY] * iz
    for k in range(3):
        w[UMAT + k] = jx * (cam[k] - rx * cam[8 + k])
        w[UMAT + 3 + k] = jy * (cam[4 + k] - ry * cam[8 + k])
    for row in range(2):
        for k in range(3):
            u = UMAT + 3 * row
            w[PMAT + 3 * row + k] = (
                w[u] * w[ROT + k] + w[u + 1] * w[ROT + 3 + k] + w[u + 2] * w[ROT + 6 + k]
            ) * scales[3 * i + k]
    return finish_covariance(w)


@part
def finish_covariance(w):  # type: ignore[no-untyped-def]
    """Covariance ``P P^T + blur`` and its determinant as a sum of squares, exact even for needles."""
    p0, p1, p2, p3, p4, p5 = w[PMAT], w[PMAT + 1], w[PMAT + 2], w[PMAT + 3], w[PMAT + 4], w[PMAT + 5]
    xx, yy = p0 * p0 + p1 * p1 + p2 * p2, p3 * p3 + p4 * p4 + p5 * p5
    w[COV], w[COV + 1], w[COV + 2] = xx + BLUR, p0 * p3 + p1 * p4 + p2 * p5, yy + BLUR
    cx, cy, cz = p1 * p5 - p2 * p4, p2 * p3 - p0 * p5, p0 * p4 - p1 * p3
    det = cx * cx + cy * cy + cz * cz + BLUR * (xx + yy) + BLUR * BLUR
    w[COVDET] = det
    return det < float32(3e38)


@part
def view_direction(means, i, cam, d):  # type: ignore[no-untyped-def]
    """Unit direction from the camera to the Gaussian into ``d``; returns 1 / distance."""
    x, y, z = means[3 * i] - cam[EYE], means[3 * i + 1] - cam[EYE + 1], means[3 * i + 2] - cam[EYE + 2]
    inverse = ONE / math.sqrt(x * x + y * y + z * z)
    d[0], d[1], d[2] = x * inverse, y * inverse, z * inverse
    return inverse


@part
def color(means, sh0, shN, i, degree, cam, basis, direction, records, r):  # type: ignore[no-untyped-def]
    """Colour ``max(0, 0.5 + SH)`` into the record at ``r``; False if it is not finite."""
    view_direction(means, i, cam, direction)
    sh_basis(degree, direction[0], direction[1], direction[2], basis)
    bands, size = (degree + 1) * (degree + 1) - 1, ZERO
    for channel in range(3):
        value = HALF + basis[0] * sh0[3 * i + channel]
        for k in range(bands):
            value += basis[k + 1] * shN[3 * (i * bands + k) + channel]
        records[r + RED + channel] = max(value, ZERO)
        size += abs(value)
    return size < float32(3e38)


@part
def record(records, r, w, opacity, cam):  # type: ignore[no-untyped-def]
    """Fills the record at ``r`` from the workspace; False if no pixel centre is reached."""
    iz = ONE / w[POINT + 2]
    records[r + MX], records[r + MY] = cam[FX] * w[POINT] * iz + cam[CX], cam[FY] * w[POINT + 1] * iz + cam[CY]
    idet = ONE / w[COVDET]
    records[r + QA], records[r + QB], records[r + QC] = (
        HALF * LOG2E * w[COV + 2] * idet,
        -LOG2E * w[COV + 1] * idet,
        HALF * LOG2E * w[COV] * idet,
    )
    records[r + DET] = LOG2E * LOG2E * idet
    records[r + LOG] = math.log2(opacity)
    records[r + REACH] = max(records[r + LOG] + LOG2_255, ZERO)
    records[r + RX] = math.sqrt(TWO_LN2 * records[r + REACH] * w[COV])
    ry = math.sqrt(TWO_LN2 * records[r + REACH] * w[COV + 2])
    records[r + X0] = max(ZERO, math.ceil(records[r + MX] - records[r + RX] - HALF - SLACK))
    records[r + X1] = min(cam[WIDTH] - ONE, math.floor(records[r + MX] + records[r + RX] - HALF + SLACK))
    records[r + Y0] = max(ZERO, math.ceil(records[r + MY] - ry - HALF - SLACK))
    records[r + Y1] = min(cam[HEIGHT] - ONE, math.floor(records[r + MY] + ry - HALF + SLACK))
    return records[r + X0] <= records[r + X1] and records[r + Y0] <= records[r + Y1]


@kernel
def project(worker, workers, means, quats, scales, opacities, sh0, shN, degree, cam, records, depths, ids, counts):  # type: ignore[no-untyped-def]
    """Writes records, depths and row numbers of this worker's visible Gaussians, packed from its first row."""
    w, basis, direction = scratch(float32, SCRATCH), scratch(float32, 25), scratch(float32, 3)
    rows = len(opacities)
    means, quats, scales, opacities = pointer(means), pointer(quats), pointer(scales), pointer(opacities)
    sh0, shN, cam, records = pointer(sh0), pointer(shN), pointer(cam), pointer(records)
    depths, ids = pointer(depths), pointer(ids)
    first = rows * worker // workers
    n = first
    for i in range(first, rows * (worker + 1) // workers):
        if not opacities[i] >= ALPHA_MIN:
            continue
        if not covariance(means, quats, scales, i, cam, w):
            continue
        if not record(records, n * RECORD, w, opacities[i], cam):
            continue
        if not color(means, sh0, shN, i, degree, cam, basis, direction, records, n * RECORD):
            continue
        depths[n] = w[POINT + 2]
        ids[n] = i
        n += 1
    counts[worker] = n - first


@kernel
def gather(worker, workers, order, packed, records, ranks):  # type: ignore[no-untyped-def]
    """Brings the records into depth order; ``ranks`` tells where each packed one went."""
    visible = len(order)
    order, packed, records, ranks = pointer(order), pointer(packed), pointer(records), pointer(ranks)
    for j in range(visible * worker // workers, visible * (worker + 1) // workers):
        for k in range(RECORD):
            records[j * RECORD + k] = packed[order[j] * RECORD + k]
        ranks[order[j]] = j
