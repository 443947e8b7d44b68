"""Projection of Gaussians to the image: the local affine approximation (EWA splatting).

Conventions of gsplat: pixel centres at +0.5, the filter's variance added to the covariance and,
with ``compensate``, the opacity compensated for it; the Jacobian's ray clamped to 1.3 times the
field of view (0.3 beyond the image on either side), the camera's near plane, alpha below 1/255
dropped. Sixteen Gaussians at a time, one per lane.
"""

from numba import float32, float64, int64, uint64

from clod_adapter._kernels.colors import color
from clod_adapter._kernels.compiling import inlined, kernel
from clod_adapter._kernels.conventions import (
    ALPHA_MIN,
    BLUE,
    COV,
    COVDET,
    DET,
    GREEN,
    HUGE,
    LOG,
    LOG2_255,
    LOG2E,
    MEAN,
    MX,
    MY,
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
    TWO_LN2,
    UMAT,
    WORKSPACE,
    X0,
    X1,
    Y0,
    Y1,
)
from clod_adapter._kernels.dial import drawn, kept, transformed
from clod_adapter._kernels.elementary import bits_of, log2, lowest, vceil, vfloor, vsqrt
from clod_adapter._kernels.pointers import (
    first_lanes,
    load,
    load_rows,
    pointers,
    scratch,
    share,
    store_rows,
)
from clod_adapter._kernels.simd import both, f32x16, ge, gt, splat, vmax, vmin


@inlined
def load_stored(stored, rows, w):
    """Loads what is stored of sixteen rows into the workspace ``w``."""
    load_rows(stored.means, rows, 3, 0, 3, w, MEAN)
    load_rows(stored.quats, rows, 4, 0, 4, w, STORED)
    load_rows(stored.scales, rows, 3, 0, 3, w, SCALE)


@inlined
def covariance(drawing, w):
    """Fills the rest of the workspace ``w``; returns which are in front of the near plane and have
    a rotation.
    """
    view = drawing.viewmat
    for d in range(3):
        w[POINT + d] = transformed(view, 4 * d, w[MEAN], w[MEAN + 1], w[MEAN + 2])
    norm2 = splat(0)
    for d in range(4):
        norm2 += w[STORED + d] * w[STORED + d]
    valid = both(ge(norm2, QUAT_MIN2), ge(QUAT_MAX2, norm2))
    valid = both(ge(w[POINT + 2], drawing.near), valid)
    w[QINV] = 1 / vsqrt(norm2)
    for d in range(4):
        w[QUAT + d] = w[STORED + d] * w[QINV]
    rotation(w)
    iz = 1 / w[POINT + 2]
    rx = vmin(vmax(w[POINT] * iz, drawing.low_x), drawing.high_x)
    ry = vmin(vmax(w[POINT + 1] * iz, drawing.low_y), drawing.high_y)
    for k in range(3):
        w[UMAT + k] = drawing.fx * iz * (view[k] - rx * view[8 + k])
        w[UMAT + 3 + k] = drawing.fy * iz * (view[4 + k] - ry * view[8 + k])
    for row in range(2):
        u = UMAT + 3 * row
        for k in range(3):
            along = w[u] * w[ROT + k] + w[u + 1] * w[ROT + 3 + k] + w[u + 2] * w[ROT + 6 + k]
            w[PMAT + 3 * row + k] = along * w[SCALE + k]
    # P P^T with and without blur, and determinants as sums of squares, exact for needles.
    blur = drawing.blur
    p0 = w[PMAT]
    p1 = w[PMAT + 1]
    p2 = w[PMAT + 2]
    p3 = w[PMAT + 3]
    p4 = w[PMAT + 4]
    p5 = w[PMAT + 5]
    xx = p0 * p0 + p1 * p1 + p2 * p2
    yy = p3 * p3 + p4 * p4 + p5 * p5
    w[COV] = xx + blur
    w[COV + 1] = p0 * p3 + p1 * p4 + p2 * p5
    w[COV + 2] = yy + blur
    cx = p1 * p5 - p2 * p4
    cy = p2 * p3 - p0 * p5
    cz = p0 * p4 - p1 * p3
    w[RAWDET] = cx * cx + cy * cy + cz * cz
    w[COVDET] = w[RAWDET] + blur * (xx + yy) + blur * blur
    return both(valid, gt(HUGE, w[COVDET]))


@inlined
def rotation(w):
    """Rotation matrix, row-major, of the unit quaternion."""
    q0 = w[QUAT]
    q1 = w[QUAT + 1]
    q2 = w[QUAT + 2]
    q3 = w[QUAT + 3]
    w[ROT] = 1 - 2 * (q2 * q2 + q3 * q3)
    w[ROT + 1] = 2 * (q1 * q2 - q0 * q3)
    w[ROT + 2] = 2 * (q1 * q3 + q0 * q2)
    w[ROT + 3] = 2 * (q1 * q2 + q0 * q3)
    w[ROT + 4] = 1 - 2 * (q1 * q1 + q3 * q3)
    w[ROT + 5] = 2 * (q2 * q3 - q0 * q1)
    w[ROT + 6] = 2 * (q1 * q3 - q0 * q2)
    w[ROT + 7] = 2 * (q2 * q3 + q0 * q1)
    w[ROT + 8] = 1 - 2 * (q1 * q1 + q2 * q2)


@inlined
def centres(means, rows, drawing, out):
    """Sixteen centres on the image, x then y in pixels, and their depths, into ``out [48]``.

    In float64: at the edge of a picture 960 wide a float32 centre is off by 1e-4 pixels, and alpha
    by as much.
    """
    view = drawing.viewmat
    for lane in range(16):
        at = 3 * rows[lane]
        x = float64(means[at])
        y = float64(means[at + 1])
        z = float64(means[at + 2])
        depth = transformed(view, 8, x, y, z)
        inverse = float64(1) / depth
        out[lane] = drawing.fx * transformed(view, 0, x, y, z) * inverse + drawing.cx
        out[16 + lane] = drawing.fy * transformed(view, 4, x, y, z) * inverse + drawing.cy
        out[32 + lane] = depth


@inlined
def make_records(w, centre, opacity, drawing, record):
    """Fills the sixteen columns of the records except the colours; returns which of them reach a
    pixel centre.
    """
    mx = load(centre, 0)
    my = load(centre, 16)
    idet = 1 / w[COVDET]
    record[MX] = mx
    record[MY] = my
    record[QA] = 0.5 * LOG2E * w[COV + 2] * idet
    record[QC] = 0.5 * LOG2E * w[COV] * idet
    record[QB] = -(LOG2E * w[COV + 1] * idet)
    record[DET] = LOG2E * LOG2E * idet
    if drawing.compensate:  # NaN for an infinite covariance, which is not drawn
        opacity = opacity * vsqrt(w[RAWDET] * idet)
    drawn = ge(opacity, ALPHA_MIN)
    record[LOG] = log2(opacity)
    record[RED] = record[GREEN] = record[BLUE] = splat(0)
    reach = vmax(record[LOG] + LOG2_255, 0)
    rx = vsqrt(TWO_LN2 * reach * w[COV])
    ry = vsqrt(TWO_LN2 * reach * w[COV + 2])
    record[REACH] = reach
    record[RX] = rx
    record[X0] = vmax(vceil(mx - rx - 0.5 - SLACK), 0)
    record[X1] = vmin(vfloor(mx + rx - 0.5 + SLACK), drawing.width - 1)
    record[Y0] = vmax(vceil(my - ry - 0.5 - SLACK), 0)
    record[Y1] = vmin(vfloor(my + ry - 0.5 + SLACK), drawing.height - 1)
    return both(drawn, both(ge(record[X1], record[X0]), ge(record[Y1], record[Y0])))


@inlined
def add_records(rows, filled, at, spare, means, opacity, drawing, w, packed):
    """Packs those of the first ``filled`` of sixteen ``rows`` that reach a pixel centre, from the
    record ``at`` on.

    ``w`` holds what is stored of the rows. Returns the number of the next record.
    """
    record = scratch(f32x16, RECORD)
    centre = scratch(float32, 48)
    targets = scratch(int64, 16)
    valid = covariance(drawing, w)
    centres(means, rows, drawing, centre)
    # beyond the near plane in float32 too, not only in float64
    valid = both(valid, ge(load(centre, 32), drawing.near))
    valid = both(
        valid, both(make_records(w, centre, opacity, drawing, record), first_lanes(filled))
    )
    bits = bits_of(valid)
    if bits == uint64(0):
        return at
    for lane in range(16):
        targets[lane] = spare
        if (bits >> uint64(lane)) & uint64(1):
            packed.depths[at] = centre[32 + lane]
            packed.ids[at] = rows[lane]
            targets[lane] = at
            at += 1
    store_rows(packed.records, targets, RECORD, 0, RECORD, record, 0)
    return at


@kernel
def project(worker, workers, stored, drawing, packed):
    """Packs this worker's visible Gaussians."""
    n = len(stored.opacities)
    first, last = share(worker, workers, n)
    stored = pointers(stored)
    drawing = pointers(drawing)
    packed = pointers(packed)
    w = scratch(f32x16, WORKSPACE)
    rows = scratch(int64, 16)
    queue = scratch(int64, 32)
    i = at = first
    queued = 0
    while i < last or queued > 0:
        while i < last and queued < 16:
            bits = kept(i, min(last - i, 16), stored, drawing)
            while bits != uint64(0):
                queue[queued] = i + lowest(bits)
                queued += 1
                bits &= bits - uint64(1)
            i += 16
        filled = min(queued, 16)
        if filled == 0:
            break
        for lane in range(16):
            rows[lane] = queue[min(lane, filled - 1)]
        for k in range(16):
            queue[k] = queue[16 + k]
        queued -= filled
        load_stored(stored, rows, w)
        opacity = drawn(rows, stored, drawing, w)
        at = add_records(rows, filled, at, n + worker, stored.means, opacity, drawing, w, packed)
    packed.counts[worker] = color(first, at - first, stored, drawing, packed)
