"""The dial's equation (``equation/attenuation.py``) as the first part of the projection.

``kept`` reads the 16 bytes of a Gaussian that decide whether it is culled, its centre and its
reach; what is culled costs nothing after that. All in float32: of a few hundred thousand Gaussians,
one at its end may be judged otherwise than by the equation, with an opacity of 0 there.
"""

from numba import float32, uint64

from clod_adapter._kernels.compiling import inlined, kernel
from clod_adapter._kernels.conventions import (
    ALPHA_MIN,
    HUGE,
    LOG2E,
    SCALE,
    SUMS,
    V_SCALE,
)
from clod_adapter._kernels.elementary import bits_of, exp2, log2, vabs
from clod_adapter._kernels.pointers import (
    first_lanes,
    gather,
    load_some,
    load_triples,
    pointer,
    pointers,
    scatter,
    scratch,
    share,
)
from clod_adapter._kernels.simd import both, f32x16, ge, gt, select, splat, vmax, vmin

LN2 = float32(0.6931471805599453)
TAKEOVER = 12  # attenuation.TAKEOVER
FARTHEST_EXPONENT = 126  # of exp2
LOG2_GROWTH_MAX = float32(20 * 1.4426950408889634)  # attenuation.LOG_GROWTH_MAX
NEARLY = float32(0.99)  # of the near plane: the projection decides exactly


@inlined
def transformed(view, row, x, y, z):
    """A coordinate in the camera's axes: that of ``row``, 0, 4 or 8, of the view matrix."""
    return view[row] * x + view[row + 1] * y + view[row + 2] * z + view[row + 3]


@inlined
def squared_distance(w, drawing):
    """Squared distances from the camera to the centres ``w[:3]``, world units^2."""
    total = splat(0)
    for k in range(3):
        offset = w[k] - drawing.eye[k]
        total += offset * offset
    return total


@inlined
def squared_reach(sigma, far2):
    """``R^2``; 1 where d s, of which ``far2`` is the square, is 0."""
    sigma = vmax(sigma, 0)
    return select(gt(far2, 0), sigma * sigma, 1)


@inlined
def takeover(far2, near2):
    """w, before it is clamped to [0, 1]."""
    return far2 * near2 * TAKEOVER - (TAKEOVER - 1)


@inlined
def survives(sigma, far2, near2):
    """A mask of the rows, of sixteen, that the dial keeps."""
    end2 = squared_reach(sigma, far2)
    if near2 > 0:
        far = gt(sigma, 0)
        takeover_share = select(far, takeover(far2, near2), 1)
        return both(gt(takeover_share, 0), gt(select(far, end2, 1 / near2), far2))
    return gt(end2, far2)


@inlined
def squared_share(sigma, far2):
    """``t^2``, at most 1."""
    return vmin(far2 / squared_reach(sigma, far2), 1)


@inlined
def reciprocal_opacity(logit):
    """``1 / sigmoid(logit)``."""
    return 1 + exp2(vmin(-logit * LOG2E, FARTHEST_EXPONENT))


@inlined
def kept(at, many, stored, drawing):
    """The bits of those of ``many`` <= 16 rows from ``at`` on that are in front of the camera and
    not culled.

    Activated ones are told by their opacity alone, from 1/255 on.
    """
    dial = drawing.dial
    if dial.activated:
        opacity = load_some(stored.opacities, at, many)
        visible = both(ge(opacity, ALPHA_MIN), gt(HUGE, opacity))
    else:
        w = scratch(f32x16, 3)
        load_triples(stored.means, at, many, w)
        depth = transformed(drawing.viewmat, 8, w[0], w[1], w[2])
        visible = ge(depth, NEARLY * drawing.near)
        if drawing.fades:
            far2 = squared_distance(w, drawing) * dial.rate2
            visible = both(visible, survives(load_some(stored.sigma, at, many), far2, dial.near2))
    return bits_of(both(visible, first_lanes(many)))


@kernel
def mark_kept(worker, workers, means, sigma, drawing, out):
    """``out [N]`` uint8: 1 for rows that the dial keeps, in front of the camera or not."""
    first, last = share(worker, workers, len(sigma))
    means = pointer(means)
    sigma = pointer(sigma)
    out = pointer(out)
    drawing = pointers(drawing)
    w = scratch(f32x16, 3)
    for i in range(first, last, 16):
        many = min(last - i, 16)
        load_triples(means, i, many, w)
        far2 = squared_distance(w, drawing) * drawing.dial.rate2
        bits = bits_of(survives(load_some(sigma, i, many), far2, drawing.dial.near2))
        for lane in range(many):
            out[i + lane] = (bits >> uint64(lane)) & uint64(1)


@inlined
def drawn(rows, stored, drawing, w):
    """The drawn opacities of sixteen rows, whose centres and logarithms of scales ``w`` holds;
    makes these scales.

    Activated ones stay as they are.
    """
    dial = drawing.dial
    opacity = gather(stored.opacities, rows)
    size = splat(0)
    if dial.activated:
        return opacity
    opacity = 1 / reciprocal_opacity(opacity)
    if drawing.fades:
        distance2 = squared_distance(w, drawing)
        reach = gather(stored.sigma, rows)
        far2 = distance2 * dial.rate2
        share2 = squared_share(reach, far2)
        fade = 1 - share2 * share2
        if dial.near2 > 0:
            takeover_share = vmin(1, vmax(0, takeover(far2, dial.near2)))
            fade = select(gt(reach, 0), fade * takeover_share, 1 - takeover_share)
        opacity = opacity * fade
        if drawing.grows:
            size = gather(stored.growth, rows) * log2_magnification(distance2, dial)
            # NaN stays, and is not drawn
            size = vmin(LOG2_GROWTH_MAX, vmax(-LOG2_GROWTH_MAX, size))
    for k in range(SCALE, SCALE + 3):
        w[k] = exp2(vmin(w[k] * LOG2E + size, FARTHEST_EXPONENT))
    return opacity


@inlined
def log2_magnification(distance2, dial):
    """``log2 m``, of squared distances in world units^2."""
    return 0.5 * log2(vmax(distance2 * dial.growth_rate2, 1))


@inlined
def dial_gradient(rows, stored, drawing, shaped, w, g, gradients):
    """Gradients of logit, sigma and growth of sixteen rows; makes those of the scales in ``g`` of
    their logarithms.

    ``w`` is as in ``drawn``, ``g`` the sums over pixels. With v, the gradient of the logarithm of
    the drawn opacity (``equation/attenuation.py``), per Gaussian::

        dL/dlogit    = v sigmoid(-logit)
        dL/dsigma    = v 4 t^4 / ((1 - t^4) sigma)      distances are constants
        dL/dlogscale = dL/dscale scale
        dL/dgrowth   = sum of dL/dlogscale, times log m         0 where the growth is clamped

    Activated opacities have no other gradient than their own.
    """
    dial = drawing.dial
    opacity = gather(stored.opacities, rows)
    if dial.activated:
        scatter(gradients.opacities, rows, g[SUMS + 3] / opacity)
        return
    odds = exp2(vmin(-opacity * LOG2E, FARTHEST_EXPONENT))  # (1 - a) / a
    total = g[SUMS + 3]
    if shaped:
        for k in range(V_SCALE, V_SCALE + 3):
            g[k] = g[k] * w[SCALE + k - V_SCALE]
    if drawing.fades:
        reach = gather(stored.sigma, rows)
        distance2 = squared_distance(w, drawing)
        share2 = squared_share(reach, distance2 * dial.rate2)
        share4 = share2 * share2
        fading = both(gt(share4, 0), gt(1, share4))
        slope = 4 * share4 / ((1 - share4) * reach)
        scatter(gradients.sigma, rows, select(fading, total * slope, 0))
        if drawing.grows and shaped:
            magnification = log2_magnification(distance2, dial)
            inside = gt(LOG2_GROWTH_MAX, vabs(gather(stored.growth, rows) * magnification))
            size = LN2 * magnification * (g[V_SCALE] + g[V_SCALE + 1] + g[V_SCALE + 2])
            scatter(gradients.growth, rows, select(inside, size, 0))
    scatter(gradients.opacities, rows, total * odds / (1 + odds))
