"""Gradient of the projection with the dial in it (``dial.py``): to what is stored, sigma and growth of each Gaussian.

With w the gradient of log a'' and f the factor of the cut (``equation/attenuation.py``), per Gaussian::

    w            = dL/dlog(drawn) (1 + (f + 2) / f where 0 < f < 1)     f's slope by log a'' is f + 2
    dL/dlogit    = w sigmoid(-logit)
    dL/dsigma    = w 2 u sigma / v                                      distances are constants
    dL/dlogscale = dL/dscale scale
    dL/dgrowth   = sum of dL/dlogscale, times log m                     0 where the growth is clamped
"""

from __future__ import annotations

from numba import float32, int64

from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.conventions import (
    GROWTH_RATE,
    HALF_EPS,
    HUGE,
    LOG2E,
    MEAN,
    ONE,
    SCALE,
    SOFT,
    THRESHOLD,
    TWO,
    WORKSPACE,
    ZERO,
)
from clod_adapter._kernels.dial import FARTHEST_EXPONENT, LN2, LOG2_GROWTH_MAX, distance, drawn, exponent
from clod_adapter._kernels.elementary import exp2, log2, vabs
from clod_adapter._kernels.pointers import pointer, scratch
from clod_adapter._kernels.project import covariance, load_stored
from clod_adapter._kernels.project_gradient import (
    GRADIENTS,
    SUMS,
    V_MEAN,
    V_QUAT,
    V_SCALE,
    V_SH0,
    add_slots,
    clear,
    color_gradient,
    covariance_gradient,
    no_gradient,
    quat_gradient,
)
from clod_adapter._kernels.rows import store_rows
from clod_adapter._kernels.sh import C0
from clod_adapter._kernels.simd import both, f32x16, gt, load, select, splat, store, vmax, vmin


@part
def dial_gradient(rows, logits, sigma, growth, cam, dial, dialled, grows, shaped, w, g, v_logits, v_sigma, v_growth):  # type: ignore[no-untyped-def]
    """Gradients of logit, sigma and growth of sixteen rows; makes those of the scales in ``g`` of their logarithms."""
    values = scratch(float32, 48)
    for lane in range(16):
        values[lane] = logits[rows[lane]]
    odds = exp2(vmin(-load(values, 0) * LOG2E, splat(FARTHEST_EXPONENT)))  # (1 - a) / a
    total = g[SUMS + 3]
    if shaped:
        for k in range(V_SCALE, V_SCALE + 3):
            g[k] = g[k] * w[SCALE + k - V_SCALE]
    if dialled:
        for lane in range(16):
            values[16 + lane] = sigma[rows[lane]]
        decay, d = vmax(load(values, 16), splat(ZERO)), distance(w[MEAN], w[MEAN + 1], w[MEAN + 2], cam)
        u = exponent(d, decay, dial)
        if dial[SOFT] > ZERO:
            opacity = exp2(-(LOG2E * u)) / (ONE + odds)
            fade = TWO * (opacity / splat(dial[THRESHOLD])) - TWO
            fading = both(both(gt(fade, splat(ZERO)), gt(splat(ONE), fade)), gt(splat(HUGE), decay))
            total = total * select(fading, TWO + TWO / fade, splat(ONE))
        slope = select(gt(u, splat(ZERO)), TWO * u * decay / (decay * decay + dial[HALF_EPS]), splat(ZERO))
        store(values, 16, total * slope)
        for lane in range(16):
            v_sigma[rows[lane]] = values[16 + lane]
        if grows and shaped:
            for lane in range(16):
                values[32 + lane] = growth[rows[lane]]
            magnification = log2(vmax(d * dial[GROWTH_RATE], splat(ONE)))
            inside = gt(splat(LOG2_GROWTH_MAX), vabs(load(values, 32) * magnification))
            size = LN2 * magnification * (g[V_SCALE] + g[V_SCALE + 1] + g[V_SCALE + 2])
            store(values, 32, select(inside, size, splat(ZERO)))
            for lane in range(16):
                v_growth[rows[lane]] = values[32 + lane]
    store(values, 0, total * odds / (ONE + odds))
    for lane in range(16):
        v_logits[rows[lane]] = values[lane]


@kernel
def project_dialled_gradient(  # type: ignore[no-untyped-def]
    worker, workers, means, quats, log_scales, logits, sigma, growth, shN, degree, cam, dial, records, packed_ids,
    counts, slots, pair_sums, compensated, trained, v_means, v_quats, v_scales, v_logits, v_sigma, v_growth, v_sh0,
    v_shN,
):  # fmt: skip
    """``project_gradient.project_gradient`` with the dial; 0 from the row ``trained`` on."""
    w, g = scratch(f32x16, WORKSPACE), scratch(f32x16, GRADIENTS)
    sh, basis = scratch(f32x16, 80), scratch(f32x16, 25)
    rows, packed, lanes, sums = scratch(int64, 16), scratch(int64, 16), scratch(int64, 16), scratch(float32, 256)
    shaped, colored, tuned = len(v_means) > 0, len(v_sh0) > 0, len(v_shN) > 0
    dialled, grows, terms = len(sigma) > 0, len(growth) > 0, (degree + 1) * (degree + 1) - 1 if tuned else 0
    first, last = len(logits) * worker // workers, len(logits) * (worker + 1) // workers
    end = first + counts[worker]
    means, quats, log_scales, logits = pointer(means), pointer(quats), pointer(log_scales), pointer(logits)
    sigma, growth, shN, cam, dial = pointer(sigma), pointer(growth), pointer(shN), pointer(cam), pointer(dial)
    records, packed_ids, slots, pair_sums = pointer(records), pointer(packed_ids), pointer(slots), pointer(pair_sums)
    v_means, v_quats, v_scales, v_logits = pointer(v_means), pointer(v_quats), pointer(v_scales), pointer(v_logits)
    v_sigma, v_growth, v_sh0, v_shN = pointer(v_sigma), pointer(v_growth), pointer(v_sh0), pointer(v_shN)
    while end > first and packed_ids[end - 1] >= trained:
        end -= 1
    if dialled:
        clear(v_sigma, first, last)
    if grows:
        clear(v_growth, first, last)
    done = first
    for start in range(first, end, 16):
        for lane in range(16):
            packed[lane], lanes[lane] = min(start + lane, end - 1), lane
            row = rows[lane] = packed_ids[packed[lane]]
            if row > done:
                no_gradient(done, row, shaped, colored, terms, v_means, v_quats, v_scales, v_logits, v_sh0, v_shN)
            done = max(done, row + 1)
        add_slots(pair_sums, slots, records, packed, lanes, sums, g)
        load_stored(means, quats, log_scales, rows, w)
        drawn(rows, logits, sigma, growth, cam, dial, dialled, grows, w)
        if shaped or tuned:
            color_gradient(w, g, shN, rows, degree, cam, sh, basis, tuned, v_shN)
        if shaped:
            covariance(cam, w)
            covariance_gradient(w, g, cam, compensated)
            quat_gradient(w, g)
            store_rows(v_means, rows, 3, 0, 3, g, V_MEAN)
            store_rows(v_quats, rows, 4, 0, 4, g, V_QUAT)
        dial_gradient(rows, logits, sigma, growth, cam, dial, dialled, grows, shaped, w, g, v_logits, v_sigma, v_growth)
        if shaped:
            store_rows(v_scales, rows, 3, 0, 3, g, V_SCALE)
        if colored:
            for k in range(3):
                g[V_SH0 + k] = C0 * g[SUMS + k]
            store_rows(v_sh0, rows, 3, 0, 3, g, V_SH0)
    no_gradient(done, last, shaped, colored, terms, v_means, v_quats, v_scales, v_logits, v_sh0, v_shN)
