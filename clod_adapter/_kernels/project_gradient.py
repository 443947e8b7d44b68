"""Gradient of the projection: from the blending's sums over pixels to the parameters of each
Gaussian.
"""

from numba import float32, int64

from clod_adapter._kernels.colors import C0, load_sh, sh_basis, sh_basis_gradient, view_direction
from clod_adapter._kernels.compiling import inlined, kernel
from clod_adapter._kernels.conventions import (
    COV,
    COVDET,
    GRADIENTS,
    PAIR,
    PMAT,
    POINT,
    QINV,
    QUAT,
    RAWDET,
    RECORD,
    RED,
    ROT,
    SCALE,
    SUMS,
    UMAT,
    V_MEAN,
    V_P,
    V_QUAT,
    V_ROT,
    V_SCALE,
    V_SH0,
    WORKSPACE,
)
from clod_adapter._kernels.dial import dial_gradient, drawn
from clod_adapter._kernels.pointers import (
    load,
    load_rows,
    pointer,
    pointers,
    scratch,
    share,
    store,
    store_rows,
)
from clod_adapter._kernels.project import covariance, load_stored
from clod_adapter._kernels.simd import eq, f32x16, gt, select, splat, vmax, vmin


@inlined
def covariance_gradient(w, g, drawing, compensated):
    """Gradients of scales, rotation matrix and mean from the sums over pixels."""
    idet = 1 / w[COVDET]
    a = w[COV + 2] * idet
    b = -(w[COV + 1] * idet)
    e = w[COV] * idet
    # dL/dP = K M (K P) with the conic K = [[a, b], [b, e]] and the second moments M of the sums. K
    # P comes from K = adj(P P^T + blur) / det term by term: for a needle, K times the long column
    # of P would cancel.
    for k in range(3):
        p0 = w[PMAT + k]
        p1 = w[PMAT + 3 + k]
        adjugate0 = adjugate1 = splat(0)  # column of adj(P P^T) P
        for j in range(3):
            if j != k:  # else it is 0, except for the rounding of a fused product
                cross = p0 * w[PMAT + 3 + j] - w[PMAT + j] * p1
                adjugate0 += w[PMAT + 3 + j] * cross
                adjugate1 -= w[PMAT + j] * cross
        t0 = (adjugate0 + drawing.blur * p0) * idet
        t1 = (adjugate1 + drawing.blur * p1) * idet
        m0 = g[SUMS + 6] * t0 + g[SUMS + 7] * t1
        m1 = g[SUMS + 7] * t0 + g[SUMS + 8] * t1
        g[V_P + k] = a * m0 + b * m1
        g[V_P + 3 + k] = b * m0 + e * m1
        if compensated is not None:
            # that of the logarithm of the compensation is (P P^T)^-1 P - K P
            inverse = 1 / w[RAWDET]
            g[V_P + k] += g[SUMS + 3] * (adjugate0 * inverse - t0)
            g[V_P + 3 + k] += g[SUMS + 3] * (adjugate1 * inverse - t1)
        g[V_SCALE + k] = splat(0)
        for d in range(3):
            v = w[UMAT + d] * g[V_P + k] + w[UMAT + 3 + d] * g[V_P + 3 + k]
            g[V_SCALE + k] += v * w[ROT + 3 * d + k]
            g[V_ROT + 3 * d + k] = v * w[SCALE + k]
    v_x = a * g[SUMS + 4] + b * g[SUMS + 5]
    v_y = b * g[SUMS + 4] + e * g[SUMS + 5]
    point_gradient(w, g, v_x, v_y, drawing)


@inlined
def point_gradient(w, g, v_x, v_y, drawing):
    """Adds the gradients through the projected centre and through the Jacobian to that of the
    mean.
    """
    view = drawing.viewmat
    x = w[POINT]
    y = w[POINT + 1]
    iz = 1 / w[POINT + 2]
    rx = x * iz
    ry = y * iz
    clamped_x = vmin(vmax(rx, drawing.low_x), drawing.high_x)
    clamped_y = vmin(vmax(ry, drawing.low_y), drawing.high_y)
    j00 = j02 = j11 = j12 = splat(0)
    for d in range(3):
        u0 = u1 = splat(0)
        for k in range(3):
            q = w[ROT + 3 * d + k] * w[SCALE + k]
            u0 += g[V_P + k] * q
            u1 += g[V_P + 3 + k] * q
        j00 += u0 * view[d]
        j02 += u0 * view[8 + d]
        j11 += u1 * view[4 + d]
        j12 += u1 * view[8 + d]
    fx = drawing.fx * iz
    fy = drawing.fy * iz
    # The projected centre, then the factor 1/z of all four entries of the Jacobian.
    v_z = -(fx * rx * v_x + fy * ry * v_y) - iz * (
        fx * (j00 - clamped_x * j02) + fy * (j11 - clamped_y * j12)
    )
    v_rx = select(eq(clamped_x, rx), -(fx * j02 * iz), 0)
    v_ry = select(eq(clamped_y, ry), -(fy * j12 * iz), 0)
    v_x = fx * v_x + v_rx
    v_y = fy * v_y + v_ry
    v_z = v_z - v_rx * rx - v_ry * ry
    for d in range(3):
        g[V_MEAN + d] += view[d] * v_x + view[4 + d] * v_y + view[8 + d] * v_z


@inlined
def quat_gradient(w, g):
    """Gradient of the stored quaternion from that of the rotation matrix."""
    q0 = w[QUAT]
    q1 = w[QUAT + 1]
    q2 = w[QUAT + 2]
    q3 = w[QUAT + 3]
    r = V_ROT
    x = g[r + 7] - g[r + 5]
    y = g[r + 2] - g[r + 6]
    z = g[r + 3] - g[r + 1]
    xy = g[r + 3] + g[r + 1]
    xz = g[r + 6] + g[r + 2]
    yz = g[r + 7] + g[r + 5]
    g[V_QUAT] = 2 * (q1 * x + q2 * y + q3 * z)
    g[V_QUAT + 1] = 2 * (q2 * xy + q3 * xz + q0 * x - 2 * q1 * (g[r + 4] + g[r + 8]))
    g[V_QUAT + 2] = 2 * (q1 * xy + q3 * yz + q0 * y - 2 * q2 * (g[r] + g[r + 8]))
    g[V_QUAT + 3] = 2 * (q1 * xz + q2 * yz + q0 * z - 2 * q3 * (g[r] + g[r + 4]))
    along = splat(0)
    for k in range(4):
        along += g[V_QUAT + k] * w[QUAT + k]
    for k in range(4):
        g[V_QUAT + k] = (g[V_QUAT + k] - along * w[QUAT + k]) * w[QINV]


@inlined
def color_gradient(w, g, shN, rows, drawing, sh, basis, tuned, v_shN):
    """Gradients of the harmonics above degree 0 if ``tuned``, and of the mean through the
    direction.
    """
    degree = drawing.degree
    inverse = view_direction(w, drawing, sh)
    x = sh[0]
    y = sh[1]
    z = sh[2]
    sh_basis(degree, x, y, z, basis)
    terms = (degree + 1) * (degree + 1) - 1
    load_sh(shN, rows, terms, sh)
    for k in range(terms):
        along_basis = splat(0)
        for channel in range(3):
            along_basis += sh[3 * k + channel] * g[SUMS + channel]
            sh[3 * k + channel] = basis[k + 1] * g[SUMS + channel]
        basis[k + 1] = along_basis
    if tuned:
        for first in range(0, 3 * terms, 16):
            store_rows(v_shN, rows, 3 * terms, first, min(3 * terms - first, 16), sh, first)
    gx, gy, gz = sh_basis_gradient(degree, x, y, z, basis)
    along = gx * x + gy * y + gz * z
    g[V_MEAN] = (gx - along * x) * inverse
    g[V_MEAN + 1] = (gy - along * y) * inverse
    g[V_MEAN + 2] = (gz - along * z) * inverse


@inlined
def clear(values, first, last, width):
    """Sets the rows from ``first`` up to ``last``, of ``width`` elements, to 0."""
    for k in range(first * width, last * width):
        values[k] = 0


@inlined
def no_gradient(first, last, shaped, colored, terms, gradients):
    """Sets the gradients of the rows from ``first`` up to ``last``, which are not visible, to 0."""
    clear(gradients.opacities, first, last, 1)
    clear(gradients.means, first, last, 3 * shaped)
    clear(gradients.quats, first, last, 4 * shaped)
    clear(gradients.scales, first, last, 3 * shaped)
    clear(gradients.sh0, first, last, 3 * colored)
    clear(gradients.shN, first, last, 3 * terms)


@inlined
def add_slots(pair_sums, slots, records, places, lanes, sums, g):
    """Sums the slots of sixteen packed Gaussians into ``g[SUMS]`` and into the rows of
    ``sums [16, 16]``.
    """
    for lane in range(16):
        total = splat(0)
        for slot in range(slots[2 * places[lane]], slots[2 * places[lane] + 1]):
            total = total + load(pair_sums, slot * PAIR)
        store(sums, 16 * lane, total)
    load_rows(sums, lanes, 16, 0, PAIR, g, SUMS)
    load_rows(records, places, RECORD, RED, 3, g, SUMS + PAIR)
    for k in range(3):  # a colour clamped at 0 has no gradient
        g[SUMS + k] = select(gt(g[SUMS + PAIR + k], 0), g[SUMS + k], 0)


@kernel
def project_gradient(
    worker, workers, stored, drawing, packed, slots, pair_sums, compensated, trained, gradients
):
    """Sums the slots of each visible Gaussian and computes the gradients of what ``project`` takes,
    in row order.

    They are 0 from the row ``trained`` on. ``compensated`` is True if the camera's filter
    compensates opacities, else None, a separate type for which numba compiles the kernel without
    compensation. Empty gradients of means, quats and scales are skipped together, and empty ones of
    sh0 or shN each.
    """
    w = scratch(f32x16, WORKSPACE)
    g = scratch(f32x16, GRADIENTS)
    sh = scratch(f32x16, 48)
    basis = scratch(f32x16, 16)
    rows = scratch(int64, 16)
    places = scratch(int64, 16)
    lanes = scratch(int64, 16)
    sums = scratch(float32, 256)
    shaped = len(gradients.means) > 0
    colored = len(gradients.sh0) > 0
    tuned = len(gradients.shN) > 0
    terms = (drawing.degree + 1) * (drawing.degree + 1) - 1 if tuned else 0
    first, last = share(worker, workers, len(stored.opacities))
    end = first + packed.counts[worker]
    stored = pointers(stored)
    drawing = pointers(drawing)
    packed = pointers(packed)
    slots = pointer(slots)
    pair_sums = pointer(pair_sums)
    gradients = pointers(gradients)
    while end > first and packed.ids[end - 1] >= trained:
        end -= 1
    clear(gradients.sigma, first, last, int64(drawing.fades))
    clear(gradients.growth, first, last, int64(drawing.grows))
    done = first
    for start in range(first, end, 16):
        for lane in range(16):
            places[lane] = min(start + lane, end - 1)
            lanes[lane] = lane
            row = rows[lane] = packed.ids[places[lane]]
            if row > done:
                no_gradient(done, row, shaped, colored, terms, gradients)
            done = max(done, row + 1)
        add_slots(pair_sums, slots, packed.records, places, lanes, sums, g)
        load_stored(stored, rows, w)
        drawn(rows, stored, drawing, w)
        if shaped or tuned:
            color_gradient(w, g, stored.shN, rows, drawing, sh, basis, tuned, gradients.shN)
        if shaped:
            covariance(drawing, w)
            covariance_gradient(w, g, drawing, compensated)
            quat_gradient(w, g)
            store_rows(gradients.means, rows, 3, 0, 3, g, V_MEAN)
            store_rows(gradients.quats, rows, 4, 0, 4, g, V_QUAT)
        dial_gradient(rows, stored, drawing, shaped, w, g, gradients)
        if shaped:
            store_rows(gradients.scales, rows, 3, 0, 3, g, V_SCALE)
        if colored:
            for k in range(3):
                g[V_SH0 + k] = C0 * g[SUMS + k]
            store_rows(gradients.sh0, rows, 3, 0, 3, g, V_SH0)
    no_gradient(done, last, shaped, colored, terms, gradients)
