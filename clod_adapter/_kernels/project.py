"""Projection of Gaussians to the image (EWA splatting) and its gradient.

Conventions of gsplat: pixel centres at +0.5, a blur of 0.3 px^2 added to the covariance, the
Jacobian's ray clamped to 1.3 times the field of view (0.3 beyond the image on either side), near
plane 0.01, alpha below 1/255 dropped.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32

from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.sh import sh_basis, sh_basis_gradient
from clod_adapter._kernels.tiles import (
    BLUE,
    DET,
    GREEN,
    LOG,
    MX,
    MY,
    QA,
    QB,
    QC,
    REACH,
    RECORD,
    RED,
    RX,
    SLACK,
    X0,
    X1,
    Y0,
    Y1,
)

BLUR, NEAR, ALPHA_MIN = float32(0.3), float32(0.01), float32(1 / 255)
LOG2E, LOG2_255, TWO_LN2 = float32(1.4426950408889634), float32(7.994353436858858), float32(1.3862943611198906)
HALF, ZERO, ONE, TWO = float32(0.5), float32(0), float32(1), float32(2)
# camera: viewmat row-major (16), fx, fy, cx, cy, width, height, ray clamp low x, high x, low y, high y,
# centre in world coordinates (3)
FX, FY, CX, CY, WIDTH, HEIGHT, LOW_X, HIGH_X, LOW_Y, HIGH_Y, EYE = range(16, 27)
CAMERA = 29
# workspace of one Gaussian: camera point (3), rotation (9), U = J R_view (6), P = U R S (6), covariance (3),
# determinant, unit quaternion (4), 1 / |quaternion|, gradient of P (6)
POINT, ROT, UMAT, PMAT, COV, COVDET, QUAT, QINV, VP, SCRATCH = 0, 3, 12, 18, 24, 27, 28, 32, 33, 39


@part
def covariance(means, quats, scales, i, cam, w):  # type: ignore[no-untyped-def]
    """Fills the workspace ``w``; False if the Gaussian is behind the near plane or has no rotation."""
    for d in range(3):
        w[POINT + d] = (
            cam[4 * d] * means[i, 0] + cam[4 * d + 1] * means[i, 1] + cam[4 * d + 2] * means[i, 2] + cam[4 * d + 3]
        )
    z = w[POINT + 2]
    norm2 = (
        quats[i, 0] * quats[i, 0] + quats[i, 1] * quats[i, 1] + quats[i, 2] * quats[i, 2] + quats[i, 3] * quats[i, 3]
    )
    if not (z >= NEAR and norm2 > ZERO):
        return False
    inverse = ONE / math.sqrt(norm2)
    w[QINV] = inverse
    q0, q1, q2, q3 = quats[i, 0] * inverse, quats[i, 1] * inverse, quats[i, 2] * inverse, quats[i, 3] * inverse
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
            ) * scales[i, k]
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
    x, y, z = means[i, 0] - cam[EYE], means[i, 1] - cam[EYE + 1], means[i, 2] - cam[EYE + 2]
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
    w, basis, direction = np.empty(SCRATCH, np.float32), np.empty(25, np.float32), np.empty(3, np.float32)
    first = len(means) * worker // workers
    n = first
    for i in range(first, len(means) * (worker + 1) // workers):
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
    for j in range(len(order) * worker // workers, len(order) * (worker + 1) // workers):
        for k in range(RECORD):
            records[j * RECORD + k] = packed[order[j] * RECORD + k]
        ranks[order[j]] = j


@part
def covariance_gradient(w, v, records, r, scales, i, cam, v_scales, v_rot, v_point):  # type: ignore[no-untyped-def]
    """From the sums ``v`` over pixels to the gradients of scale, rotation matrix and camera point."""
    ln2 = ONE / LOG2E
    a, b, c = TWO * ln2 * records[r + QA], ln2 * records[r + QB], TWO * ln2 * records[r + QC]
    # dL/dP = K M (K P) with the conic K = [[a, b], [b, c]] and the second moments M of v. K P comes from
    # K = adj(P P^T + blur) / det term by term: for a needle, K times its long column of P would cancel to noise.
    idet = ONE / w[COVDET]
    for k in range(3):
        p0, p1 = w[PMAT + k], w[PMAT + 3 + k]
        t0, t1 = BLUR * p0, BLUR * p1
        for j in range(3):
            cross = p0 * w[PMAT + 3 + j] - w[PMAT + j] * p1
            t0 += w[PMAT + 3 + j] * cross
            t1 -= w[PMAT + j] * cross
        t0, t1 = t0 * idet, t1 * idet
        m0, m1 = v[6] * t0 + v[7] * t1, v[7] * t0 + v[8] * t1
        vp0, vp1 = a * m0 + b * m1, b * m0 + c * m1
        w[VP + k], w[VP + 3 + k] = vp0, vp1
        total = ZERO
        for d in range(3):
            vq = w[UMAT + d] * vp0 + w[UMAT + 3 + d] * vp1
            total += vq * w[ROT + 3 * d + k]
            v_rot[3 * d + k] = vq * scales[i, k]
        v_scales[i, k] = total
    point_gradient(w, a * v[4] + b * v[5], b * v[4] + c * v[5], scales, i, cam, v_point)


@part
def point_gradient(w, v_x, v_y, scales, i, cam, v_point):  # type: ignore[no-untyped-def]
    """Gradient of the camera-space point: through the projected centre and through the Jacobian."""
    x, y, iz = w[POINT], w[POINT + 1], ONE / w[POINT + 2]
    rx, ry = x * iz, y * iz
    clamped_x, clamped_y = min(max(rx, cam[LOW_X]), cam[HIGH_X]), min(max(ry, cam[LOW_Y]), cam[HIGH_Y])
    j00 = j02 = j11 = j12 = ZERO
    for d in range(3):
        u0 = u1 = ZERO
        for k in range(3):
            q = w[ROT + 3 * d + k] * scales[i, k]
            u0 += w[VP + k] * q
            u1 += w[VP + 3 + k] * q
        j00 += u0 * cam[d]
        j02 += u0 * cam[8 + d]
        j11 += u1 * cam[4 + d]
        j12 += u1 * cam[8 + d]
    fx, fy = cam[FX] * iz, cam[FY] * iz
    v_rx, v_ry = -fx * j02, -fy * j12
    v_point[0], v_point[1] = fx * v_x, fy * v_y
    # The projected centre, then the factor 1/z of all four entries of the Jacobian.
    v_point[2] = -(fx * rx * v_x + fy * ry * v_y) - iz * (fx * (j00 - clamped_x * j02) + fy * (j11 - clamped_y * j12))
    if clamped_x == rx:
        v_point[0] += v_rx * iz
        v_point[2] -= v_rx * rx * iz
    if clamped_y == ry:
        v_point[1] += v_ry * iz
        v_point[2] -= v_ry * ry * iz


@part
def quat_gradient(w, v_rot, out, i):  # type: ignore[no-untyped-def]
    """Gradient of the stored quaternion from that of the rotation matrix."""
    q0, q1, q2, q3 = w[QUAT], w[QUAT + 1], w[QUAT + 2], w[QUAT + 3]
    r = v_rot
    v0 = TWO * (q1 * (r[7] - r[5]) + q2 * (r[2] - r[6]) + q3 * (r[3] - r[1]))
    v1 = TWO * (-TWO * q1 * (r[4] + r[8]) + q2 * (r[3] + r[1]) + q3 * (r[6] + r[2]) + q0 * (r[7] - r[5]))
    v2 = TWO * (q1 * (r[3] + r[1]) - TWO * q2 * (r[0] + r[8]) + q3 * (r[7] + r[5]) + q0 * (r[2] - r[6]))
    v3 = TWO * (q1 * (r[6] + r[2]) + q2 * (r[7] + r[5]) - TWO * q3 * (r[0] + r[4]) + q0 * (r[3] - r[1]))
    along = v0 * q0 + v1 * q1 + v2 * q2 + v3 * q3
    out[i, 0], out[i, 1] = (v0 - along * q0) * w[QINV], (v1 - along * q1) * w[QINV]
    out[i, 2], out[i, 3] = (v2 - along * q2) * w[QINV], (v3 - along * q3) * w[QINV]


@part
def color_gradient(means, shN, i, degree, cam, records, r, v, basis, direction, products, v_sh0, v_shN, v_means):  # type: ignore[no-untyped-def]
    """Gradients of the SH coefficients, and of the mean through the viewing direction (into ``v_means``)."""
    inverse = view_direction(means, i, cam, direction)
    sh_basis(degree, direction[0], direction[1], direction[2], basis)
    red = v[0] if records[r + RED] > ZERO else ZERO
    green = v[1] if records[r + GREEN] > ZERO else ZERO
    blue = v[2] if records[r + BLUE] > ZERO else ZERO
    v_sh0[3 * i], v_sh0[3 * i + 1], v_sh0[3 * i + 2] = basis[0] * red, basis[0] * green, basis[0] * blue
    bands = (degree + 1) * (degree + 1) - 1
    for k in range(bands):
        at, b = 3 * (i * bands + k), basis[k + 1]
        v_shN[at], v_shN[at + 1], v_shN[at + 2] = b * red, b * green, b * blue
        products[k + 1] = shN[at] * red + shN[at + 1] * green + shN[at + 2] * blue
    gx, gy, gz = sh_basis_gradient(degree, direction[0], direction[1], direction[2], products)
    along = gx * direction[0] + gy * direction[1] + gz * direction[2]
    v_means[i, 0] = (gx - along * direction[0]) * inverse
    v_means[i, 1] = (gy - along * direction[1]) * inverse
    v_means[i, 2] = (gz - along * direction[2]) * inverse


@part
def no_gradient(first, last, bands, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN):  # type: ignore[no-untyped-def]
    """Zeros for the rows from ``first`` up to ``last``, which took no part."""
    v_means[first:last] = ZERO
    v_quats[first:last] = ZERO
    v_scales[first:last] = ZERO
    v_opacities[first:last] = ZERO
    v_sh0[3 * first : 3 * last] = ZERO
    v_shN[3 * bands * first : 3 * bands * last] = ZERO


@kernel
def project_gradient(  # type: ignore[no-untyped-def]
    worker, workers, means, quats, scales, opacities, shN, degree, cam, records, packed_ids, counts, ranks, slots,
    pair_sums, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN,
):  # fmt: skip
    """Sums each visible Gaussian's slots and carries them back to its parameters; row order, so memory streams."""
    w, basis, direction = np.empty(SCRATCH, np.float32), np.empty(25, np.float32), np.empty(3, np.float32)
    v, v_rot, v_point = np.empty(9, np.float32), np.empty(9, np.float32), np.empty(3, np.float32)
    products = np.empty(25, np.float32)
    bands = (degree + 1) * (degree + 1) - 1
    first = len(means) * worker // workers
    done = first
    for p in range(first, first + counts[worker]):
        i, j = packed_ids[p], ranks[p]
        no_gradient(done, i, bands, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN)
        done = i + 1
        v[:] = ZERO
        for slot in range(slots[j], slots[j + 1]):
            for k in range(9):
                v[k] += pair_sums[slot * 9 + k]
        covariance(means, quats, scales, i, cam, w)
        v_opacities[i] = v[3] / opacities[i]
        covariance_gradient(w, v, records, j * RECORD, scales, i, cam, v_scales, v_rot, v_point)
        quat_gradient(w, v_rot, v_quats, i)
        color_gradient(
            means, shN, i, degree, cam, records, j * RECORD, v, basis, direction, products, v_sh0, v_shN, v_means
        )
        for d in range(3):
            v_means[i, d] += cam[d] * v_point[0] + cam[4 + d] * v_point[1] + cam[8 + d] * v_point[2]
    last = len(means) * (worker + 1) // workers
    no_gradient(done, last, bands, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN)
