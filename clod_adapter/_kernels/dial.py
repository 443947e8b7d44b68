"""The dial's equation (``equation/attenuation.py``, ``equation/growth.py``) as the first part of the projection.

``kept`` reads the 20 bytes of a Gaussian that decide whether it is culled, sixteen consecutive ones at a time; what is
culled costs nothing after that. What is kept gets its drawn opacity and its scales where these are projected. All in
float32: of a few hundred thousand Gaussians, one at the culling threshold may be judged otherwise than by the equation,
with an opacity of 0 there (soft cut). A row whose sigma is infinite has no dial and no cut.
"""

from numba import float32, int64, uint64

from clod_adapter._kernels import conventions as c
from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.elementary import bits_of, exp2, log2, vabs, vsqrt
from clod_adapter._kernels.pointers import load_rows, load_triples, pointer, scratch
from clod_adapter._kernels.simd import both, f32x16, ge, gt, load, select, splat, store, vmax, vmin

LN2 = float32(0.6931471805599453)
FARTHEST_EXPONENT = float32(126)  # of exp2
LOG2_GROWTH_MAX = float32(20 * 1.4426950408889634)  # growth.LOG_GROWTH_MAX
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
    ratio = d * dial[c.RATE] / vsqrt(sigma * sigma + dial[c.HALF_EPS])
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
    return gt(select(gt(splat(c.HUGE), decay), log_opacity, splat(c.ZERO)), splat(dial[c.LOG_THRESHOLD]))


@part
def kept(at, many, means, opacities, sigma, cam, dial, dialled):
    """The bits of those of ``many`` rows from ``at`` on that are in front of the camera and not culled.

    Activated opacities are 1/255 at least.
    """
    if dial[c.ACTIVATED] > c.ZERO:
        shown = both(ge(load(opacities, at), splat(c.ALPHA_MIN)), gt(splat(c.HUGE), load(opacities, at)))
    else:
        w = scratch(f32x16, 3)
        load_triples(means, 3 * at, w)
        depth = cam[8] * w[0] + cam[9] * w[1] + cam[10] * w[2] + cam[11]
        shown = ge(depth, splat(NEARLY * cam[c.NEAR]))
        if dialled:
            shown = both(shown, survives(w, load(opacities, at), load(sigma, at), cam, dial))
    return bits_of(shown) & ((uint64(1) << uint64(many)) - uint64(1))


@kernel
def mark_kept(worker, workers, means, logits, sigma, cam, dial, out):
    """``out [N]`` uint8: 1 for rows that the dial keeps, in front of the camera or not."""
    first, last = len(logits) * worker // workers, len(logits) * (worker + 1) // workers
    means, logits, sigma, out = pointer(means), pointer(logits), pointer(sigma), pointer(out)
    cam, dial = pointer(cam), pointer(dial)
    w, rows, values = scratch(f32x16, 16), scratch(int64, 16), scratch(float32, 32)
    for i in range(first, last, 16):
        for lane in range(16):
            rows[lane] = min(i + lane, last - 1)
            values[lane], values[16 + lane] = logits[rows[lane]], sigma[rows[lane]]
        load_rows(means, rows, 3, 0, 3, w, 0)
        bits = bits_of(survives(w, load(values, 0), load(values, 16), cam, dial))
        for lane in range(min(last - i, 16)):
            out[i + lane] = (bits >> uint64(lane)) & uint64(1)


@part
def drawn(rows, opacities, sigma, growth, cam, dial, dialled, grows, w):
    """The drawn opacities of sixteen rows, whose centres and logarithms of scales ``w`` holds; makes these scales.

    Activated ones stay as they are.
    """
    values = scratch(float32, 48)
    for lane in range(16):
        values[lane] = opacities[rows[lane]]
    if dial[c.ACTIVATED] > c.ZERO:
        return load(values, 0)
    opacity = c.ONE / reciprocal_opacity(load(values, 0))
    size = splat(c.ZERO)
    if dialled:
        for lane in range(16):
            values[16 + lane] = sigma[rows[lane]]
        d = distance(w[c.MEAN], w[c.MEAN + 1], w[c.MEAN + 2], cam)
        decay = load(values, 16)
        opacity = opacity * exp2(-(c.LOG2E * exponent(d, decay, dial)))
        if dial[c.SOFT] > c.ZERO:
            fade = c.TWO * (opacity / splat(dial[c.THRESHOLD])) - c.TWO
            fade = select(gt(splat(c.HUGE), decay), vmin(vmax(fade, splat(c.ZERO)), splat(c.ONE)), splat(c.ONE))
            opacity = opacity * fade
        if grows:
            for lane in range(16):
                values[32 + lane] = growth[rows[lane]]
            size = load(values, 32) * log2(vmax(d * dial[c.GROWTH_RATE], splat(c.ONE)))
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
    values = scratch(float32, 48)
    for lane in range(16):
        values[lane] = opacities[rows[lane]]
    if dial[c.ACTIVATED] > c.ZERO:
        store(values, 0, g[c.SUMS + 3] / load(values, 0))
        for lane in range(16):
            v_opacities[rows[lane]] = values[lane]
        return
    odds = exp2(vmin(-load(values, 0) * c.LOG2E, splat(FARTHEST_EXPONENT)))  # (1 - a) / a
    total = g[c.SUMS + 3]
    if shaped:
        for k in range(c.V_SCALE, c.V_SCALE + 3):
            g[k] = g[k] * w[c.SCALE + k - c.V_SCALE]
    if dialled:
        for lane in range(16):
            values[16 + lane] = sigma[rows[lane]]
        decay, d = vmax(load(values, 16), splat(c.ZERO)), distance(w[c.MEAN], w[c.MEAN + 1], w[c.MEAN + 2], cam)
        u = exponent(d, decay, dial)
        if dial[c.SOFT] > c.ZERO:
            opacity = exp2(-(c.LOG2E * u)) / (c.ONE + odds)
            fade = c.TWO * (opacity / splat(dial[c.THRESHOLD])) - c.TWO
            fading = both(both(gt(fade, splat(c.ZERO)), gt(splat(c.ONE), fade)), gt(splat(c.HUGE), decay))
            total = total * select(fading, c.TWO + c.TWO / fade, splat(c.ONE))
        slope = select(gt(u, splat(c.ZERO)), c.TWO * u * decay / (decay * decay + dial[c.HALF_EPS]), splat(c.ZERO))
        store(values, 16, total * slope)
        for lane in range(16):
            v_sigma[rows[lane]] = values[16 + lane]
        if grows and shaped:
            for lane in range(16):
                values[32 + lane] = growth[rows[lane]]
            magnification = log2(vmax(d * dial[c.GROWTH_RATE], splat(c.ONE)))
            inside = gt(splat(LOG2_GROWTH_MAX), vabs(load(values, 32) * magnification))
            size = LN2 * magnification * (g[c.V_SCALE] + g[c.V_SCALE + 1] + g[c.V_SCALE + 2])
            store(values, 32, select(inside, size, splat(c.ZERO)))
            for lane in range(16):
                v_growth[rows[lane]] = values[32 + lane]
    store(values, 0, total * odds / (c.ONE + odds))
    for lane in range(16):
        v_opacities[rows[lane]] = values[lane]
