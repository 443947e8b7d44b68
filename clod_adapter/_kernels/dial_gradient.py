"""Gradient of the projection with the dial in it (``dial.py``): to what is stored, sigma and growth of each Gaussian.

With w the gradient of log a'' and f the factor of the cut (``equation/attenuation.py``), per Gaussian::

    w            = dL/dlog(drawn) (1 + (f + 2) / f where 0 < f < 1)     f's slope by log a'' is f + 2
    dL/dlogit    = w sigmoid(-logit)
    dL/dsigma    = w 2 u sigma / v                                      distances are constants
    dL/dlogscale = dL/dscale scale
    dL/dgrowth   = sum of dL/dlogscale, times log m                     0 where the growth is clamped
"""

from __future__ import annotations

from numba import float32

from clod_adapter._kernels import conventions as c
from clod_adapter._kernels.compiling import part
from clod_adapter._kernels.dial import FARTHEST_EXPONENT, LN2, LOG2_GROWTH_MAX, distance, exponent
from clod_adapter._kernels.elementary import exp2, log2, vabs
from clod_adapter._kernels.pointers import scratch
from clod_adapter._kernels.simd import both, gt, load, select, splat, store, vmax, vmin


@part
def dial_gradient(rows, given, cam, dial, dialled, grows, shaped, w, g):  # type: ignore[no-untyped-def]
    """Gradients of logit, sigma and growth of sixteen rows; makes those of the scales in ``g`` of their logarithms.

    Without a ``dial``, that of the activated opacity alone. ``given`` are the three, and where their gradients go.
    """
    opacities, sigma, growth, v_opacities, v_sigma, v_growth = given
    values = scratch(float32, 48)
    for lane in range(16):
        values[lane] = opacities[rows[lane]]
    if dial is None:
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
