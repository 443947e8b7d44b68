"""Gradient of the projection: from the blending's sums over pixels to the parameters of each Gaussian."""

from __future__ import annotations

from numba import float32

from clod_adapter._kernels.compiling import kernel, part, pointer, scratch
from clod_adapter._kernels.conventions import (
    BLUE,
    BLUR,
    COVDET,
    FX,
    FY,
    GREEN,
    HIGH_X,
    HIGH_Y,
    LOG2E,
    LOW_X,
    LOW_Y,
    ONE,
    PAIR,
    PMAT,
    POINT,
    QA,
    QB,
    QC,
    QINV,
    QUAT,
    RECORD,
    RED,
    ROT,
    SCRATCH,
    TWO,
    UMAT,
    VP,
    ZERO,
)
from clod_adapter._kernels.project import covariance, view_direction
from clod_adapter._kernels.sh import sh_basis, sh_basis_gradient


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
            v_rot[3 * d + k] = vq * scales[3 * i + k]
        v_scales[3 * i + k] = total
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
            q = w[ROT + 3 * d + k] * scales[3 * i + k]
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
    out[4 * i], out[4 * i + 1] = (v0 - along * q0) * w[QINV], (v1 - along * q1) * w[QINV]
    out[4 * i + 2], out[4 * i + 3] = (v2 - along * q2) * w[QINV], (v3 - along * q3) * w[QINV]


@part
def color_gradient(means, shN, i, degree, cam, records, r, v, basis, direction, products, tuned, v_sh0, v_shN, v_means):  # type: ignore[no-untyped-def]
    """Gradients of the SH coefficients (the higher bands if ``tuned``), and of the mean through the direction."""
    inverse = view_direction(means, i, cam, direction)
    sh_basis(degree, direction[0], direction[1], direction[2], basis)
    red = v[0] if records[r + RED] > ZERO else ZERO
    green = v[1] if records[r + GREEN] > ZERO else ZERO
    blue = v[2] if records[r + BLUE] > ZERO else ZERO
    v_sh0[3 * i], v_sh0[3 * i + 1], v_sh0[3 * i + 2] = basis[0] * red, basis[0] * green, basis[0] * blue
    bands = (degree + 1) * (degree + 1) - 1
    for k in range(bands):
        at, b = 3 * (i * bands + k), basis[k + 1]
        if tuned:
            v_shN[at], v_shN[at + 1], v_shN[at + 2] = b * red, b * green, b * blue
        products[k + 1] = shN[at] * red + shN[at + 1] * green + shN[at + 2] * blue
    gx, gy, gz = sh_basis_gradient(degree, direction[0], direction[1], direction[2], products)
    along = gx * direction[0] + gy * direction[1] + gz * direction[2]
    v_means[3 * i] = (gx - along * direction[0]) * inverse
    v_means[3 * i + 1] = (gy - along * direction[1]) * inverse
    v_means[3 * i + 2] = (gz - along * direction[2]) * inverse


@part
def no_gradient(first, last, bands, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN):  # type: ignore[no-untyped-def]
    """Zeros for the rows from ``first`` up to ``last``, which took no part."""
    for i in range(first, last):
        v_opacities[i] = ZERO
        for d in range(3):
            v_means[3 * i + d] = v_scales[3 * i + d] = v_sh0[3 * i + d] = ZERO
        for d in range(4):
            v_quats[4 * i + d] = ZERO
    for k in range(3 * bands * first, 3 * bands * last):
        v_shN[k] = ZERO


@kernel
def project_gradient(  # type: ignore[no-untyped-def]
    worker, workers, means, quats, scales, opacities, shN, degree, cam, records, packed_ids, counts, ranks, slots,
    pair_sums, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN,
):  # fmt: skip
    """Sums each visible Gaussian's slots and carries them back to its parameters; row order, so memory streams.

    An empty ``v_shN`` leaves the gradient of the higher bands out.
    """
    w, basis, direction = scratch(float32, SCRATCH), scratch(float32, 25), scratch(float32, 3)
    v, v_rot, v_point = scratch(float32, 9), scratch(float32, 9), scratch(float32, 3)
    products = scratch(float32, 25)
    tuned = len(v_shN) > 0
    tuned_bands = (degree + 1) * (degree + 1) - 1 if tuned else 0
    rows, count = len(opacities), counts[worker]
    means, quats, scales, opacities = pointer(means), pointer(quats), pointer(scales), pointer(opacities)
    shN, cam, records, packed_ids = pointer(shN), pointer(cam), pointer(records), pointer(packed_ids)
    ranks, slots, pair_sums = pointer(ranks), pointer(slots), pointer(pair_sums)
    v_means, v_quats, v_scales = pointer(v_means), pointer(v_quats), pointer(v_scales)
    v_opacities, v_sh0, v_shN = pointer(v_opacities), pointer(v_sh0), pointer(v_shN)
    first = rows * worker // workers
    done = first
    for p in range(first, first + count):
        i, j = packed_ids[p], ranks[p]
        if i > done:
            no_gradient(done, i, tuned_bands, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN)
        done = i + 1
        for k in range(PAIR):
            v[k] = ZERO
        for slot in range(slots[j], slots[j + 1]):
            for k in range(PAIR):
                v[k] += pair_sums[slot * PAIR + k]
        covariance(means, quats, scales, i, cam, w)
        v_opacities[i] = v[3] / opacities[i]
        covariance_gradient(w, v, records, j * RECORD, scales, i, cam, v_scales, v_rot, v_point)
        quat_gradient(w, v_rot, v_quats, i)
        color_gradient(
            means, shN, i, degree, cam, records, j * RECORD, v, basis, direction, products, tuned, v_sh0, v_shN, v_means
        )
        for d in range(3):
            v_means[3 * i + d] += cam[d] * v_point[0] + cam[4 + d] * v_point[1] + cam[8 + d] * v_point[2]
    last = rows * (worker + 1) // workers
    no_gradient(done, last, tuned_bands, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN)
