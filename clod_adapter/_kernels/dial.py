"""The dial's equation (``equation/attenuation.py``) as the first part of the projection.

``kept`` reads the 20 bytes of a Gaussian that decide whether it is culled; what is culled costs nothing after that.
All in float32: of a few hundred thousand Gaussians, one at the culling threshold may be judged otherwise than by the
equation, with an opacity of 0 there (soft cut). A row whose sigma is infinite has no dial and no cut.
"""

from numba import float32, uint64

from clod_adapter._kernels import conventions as c
from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.elementary import bits_of, exp2, log2, vabs, vsqrt
from clod_adapter._kernels.pointers import first_lanes, gather, load_some, load_triples, pointer, scatter, scratch
from clod_adapter._kernels.simd import both, f32x16, ge, gt, select, splat, vmax, vmin

# A dial: s / D and s / (D r), in 1 / world units, half the equation's eps, the culling threshold, its logarithm, 1 for
# the soft cut, and 1 where scales and opacities are activated and there is no dial.
RATE, GROWTH_RATE, HALF_EPS, THRESHOLD, LOG_THRESHOLD, SOFT, ACTIVATED = range(7)
DIAL = ACTIVATED + 1

LN2 = float32(0.6931471805599453)
FARTHEST_EXPONENT = float32(126)  # of exp2
LOG2_GROWTH_MAX = float32(20 * 1.4426950408889634)  # attenuation.LOG_GROWTH_MAX
NEARLY = float32(0.99)  # of the near plane: the projection decides exactly


@part
def distance(x, y, z, cam):
    """From the camera's centre, world units."""
    dx, dy, dz = x - cam[c.EYE], y - cam[c.EYE + 1], z - cam[c.EYE + 2]
    return vsqrt(dx * dx + dy * dy + dz * dz)


@part
def exponent(d, sigma, dial):
    """``u = (d s)^2 / (2 v)``; 0 where d is 0."""
    sigma = vmax(sigma, splat(c.ZERO))
    ratio = d * dial[RATE] / vsqrt(sigma * sigma + dial[HALF_EPS])
    return select(gt(d, splat(c.ZERO)), c.HALF * ratio * ratio, splat(c.ZERO))


@part
def reciprocal_opacity(logit):
    """``1 / sigmoid(logit)``."""
    return c.ONE + exp2(vmin(-logit * c.LOG2E, splat(FARTHEST_EXPONENT)))


@part
def survives(w, logit, decay, cam, dial):
    """Which of sixteen rows with centres ``w[:3]`` the dial keeps."""
    u = exponent(distance(w[0], w[1], w[2], cam), decay, dial)
    log_opacity = -(LN2 * log2(reciprocal_opacity(logit))) - u
    return gt(select(gt(splat(c.HUGE), decay), log_opacity, splat(c.ZERO)), splat(dial[LOG_THRESHOLD]))


@part
def kept(at, many, means, opacities, sigma, cam, dial, dialled):
    """The bits of those of ``many`` <= 16 rows from ``at`` on that are in front of the camera and not culled.

    Activated opacities are 1/255 at least.
    """
    opacity = load_some(opacities, at, many)
    if dial[ACTIVATED] > c.ZERO:
        shown = both(ge(opacity, splat(c.ALPHA_MIN)), gt(splat(c.HUGE), opacity))
    else:
        w = scratch(f32x16, 3)
        load_triples(means, at, many, w)
        depth = cam[8] * w[0] + cam[9] * w[1] + cam[10] * w[2] + cam[11]
        shown = ge(depth, splat(NEARLY * cam[c.NEAR]))
        if dialled:
            shown = both(shown, survives(w, opacity, load_some(sigma, at, many), cam, dial))
    return bits_of(both(shown, first_lanes(many)))


@kernel
def mark_kept(worker, workers, means, logits, sigma, cam, dial, out):
    """``out [N]`` uint8: 1 for rows that the dial keeps, in front of the camera or not."""
    first, last = len(logits) * worker // workers, len(logits) * (worker + 1) // workers
    means, logits, sigma, out = pointer(means), pointer(logits), pointer(sigma), pointer(out)
    cam, dial, w = pointer(cam), pointer(dial), scratch(f32x16, 3)
    for i in range(first, last, 16):
        many = min(last - i, 16)
        load_triples(means, i, many, w)
        bits = bits_of(survives(w, load_some(logits, i, many), load_some(sigma, i, many), cam, dial))
        for lane in range(many):
            out[i + lane] = (bits >> uint64(lane)) & uint64(1)


@part
def drawn(rows, opacities, sigma, growth, cam, dial, dialled, grows, w):
    """The drawn opacities of sixteen rows, whose centres and logarithms of scales ``w`` holds; makes these scales.

    Activated ones stay as they are.
    """
    opacity, size = gather(opacities, rows), splat(c.ZERO)
    if dial[ACTIVATED] > c.ZERO:
        return opacity
    opacity = c.ONE / reciprocal_opacity(opacity)
    if dialled:
        d, decay = distance(w[c.MEAN], w[c.MEAN + 1], w[c.MEAN + 2], cam), gather(sigma, rows)
        opacity = opacity * exp2(-(c.LOG2E * exponent(d, decay, dial)))
        if dial[SOFT] > c.ZERO:
            fade = c.TWO * (opacity / splat(dial[THRESHOLD])) - c.TWO
            fade = select(gt(splat(c.HUGE), decay), vmin(vmax(fade, splat(c.ZERO)), splat(c.ONE)), splat(c.ONE))
            opacity = opacity * fade
        if grows:
            size = gather(growth, rows) * log2(vmax(d * dial[GROWTH_RATE], splat(c.ONE)))
            size = vmin(splat(LOG2_GROWTH_MAX), vmax(splat(-LOG2_GROWTH_MAX), size))  # NaN stays, and is not drawn
    for k in range(c.SCALE, c.SCALE + 3):
        w[k] = exp2(vmin(w[k] * c.LOG2E + size, splat(FARTHEST_EXPONENT)))
    return opacity


@part
def dial_gradient(rows, given, cam, dial, dialled, grows, shaped, w, g):
    """Gradients of logit, sigma and growth of sixteen rows; makes those of the scales in ``g`` of their logarithms.

    With w the gradient of log a'' and f the factor of the cut (``equation/attenuation.py``), per Gaussian::

        w            = dL/dlog(drawn) (1 + (f + 2) / f where 0 < f < 1)     f's slope by log a'' is f + 2
        dL/dlogit    = w sigmoid(-logit)
        dL/dsigma    = w 2 u sigma / v                                      distances are constants
        dL/dlogscale = dL/dscale scale
        dL/dgrowth   = sum of dL/dlogscale, times log m                     0 where the growth is clamped

    Of activated ones, that of the opacity alone. ``given`` are the three, and where their gradients go.
    """
    opacities, sigma, growth, v_opacities, v_sigma, v_growth = given
    opacity = gather(opacities, rows)
    if dial[ACTIVATED] > c.ZERO:
        scatter(v_opacities, rows, g[c.SUMS + 3] / opacity)
        return
    odds = exp2(vmin(-opacity * c.LOG2E, splat(FARTHEST_EXPONENT)))  # (1 - a) / a
    total = g[c.SUMS + 3]
    if shaped:
        for k in range(c.V_SCALE, c.V_SCALE + 3):
            g[k] = g[k] * w[c.SCALE + k - c.V_SCALE]
    if dialled:
        decay, d = vmax(gather(sigma, rows), splat(c.ZERO)), distance(w[c.MEAN], w[c.MEAN + 1], w[c.MEAN + 2], cam)
        u = exponent(d, decay, dial)
        if dial[SOFT] > c.ZERO:
            attenuated = exp2(-(c.LOG2E * u)) / (c.ONE + odds)
            fade = c.TWO * (attenuated / splat(dial[THRESHOLD])) - c.TWO
            fading = both(both(gt(fade, splat(c.ZERO)), gt(splat(c.ONE), fade)), gt(splat(c.HUGE), decay))
            total = total * select(fading, c.TWO + c.TWO / fade, splat(c.ONE))
        slope = select(gt(u, splat(c.ZERO)), c.TWO * u * decay / (decay * decay + dial[HALF_EPS]), splat(c.ZERO))
        scatter(v_sigma, rows, total * slope)
        if grows and shaped:
            magnification = log2(vmax(d * dial[GROWTH_RATE], splat(c.ONE)))
            inside = gt(splat(LOG2_GROWTH_MAX), vabs(gather(growth, rows) * magnification))
            size = LN2 * magnification * (g[c.V_SCALE] + g[c.V_SCALE + 1] + g[c.V_SCALE + 2])
            scatter(v_growth, rows, select(inside, size, splat(c.ZERO)))
    scatter(v_opacities, rows, total * odds / (c.ONE + odds))
