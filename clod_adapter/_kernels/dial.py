"""The dial's equation (``equation/attenuation.py``, ``equation/growth.py``) as the first part of the projection.

``kept`` reads the 20 bytes of a Gaussian that decide whether it is culled, sixteen consecutive ones at a time; what is
culled costs nothing after that. What is kept gets its drawn opacity and its scales where these are projected. All in
float32: of a few hundred thousand Gaussians, one at the culling threshold may be judged otherwise than by the equation,
with an opacity of 0 there (soft cut). A row whose sigma is infinite has no dial and no cut.
"""

from __future__ import annotations

from numba import float32, int64, uint64

from clod_adapter._kernels.bits import bits_of, lowest
from clod_adapter._kernels.colors import color
from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.conventions import (
    EYE,
    GROWTH_RATE,
    HALF,
    HALF_EPS,
    HUGE,
    LOG2E,
    LOG_THRESHOLD,
    MEAN,
    NEAR,
    ONE,
    RATE,
    SCALE,
    SOFT,
    THRESHOLD,
    TWO,
    WORKSPACE,
    ZERO,
)
from clod_adapter._kernels.elementary import exp2, log2, vsqrt
from clod_adapter._kernels.pointers import pointer, scratch
from clod_adapter._kernels.project import add_records, load_stored
from clod_adapter._kernels.rows import load_rows, load_triples
from clod_adapter._kernels.simd import both, f32x16, ge, gt, load, select, splat, vmax, vmin

LN2 = float32(0.6931471805599453)
FARTHEST_EXPONENT = float32(126)  # of exp2
LOG2_GROWTH_MAX = float32(20 * 1.4426950408889634)  # growth.LOG_GROWTH_MAX
NEARLY = float32(0.99)  # of the near plane: the projection decides exactly


@part
def distance(x, y, z, cam):  # type: ignore[no-untyped-def]
    """From the camera's centre, world units."""
    dx, dy, dz = x - cam[EYE], y - cam[EYE + 1], z - cam[EYE + 2]
    return vsqrt(dx * dx + dy * dy + dz * dz)


@part
def exponent(d, sigma, dial):  # type: ignore[no-untyped-def]
    """``u = (d s)^2 / (2 v)``; 0 where d is 0."""
    sigma = vmax(sigma, splat(ZERO))
    ratio = d * dial[RATE] / vsqrt(sigma * sigma + dial[HALF_EPS])
    return select(gt(d, splat(ZERO)), HALF * ratio * ratio, splat(ZERO))


@part
def reciprocal_opacity(logit):  # type: ignore[no-untyped-def]
    """``1 / sigmoid(logit)``."""
    return ONE + exp2(vmin(-logit * LOG2E, splat(FARTHEST_EXPONENT)))


@part
def survives(w, logit, decay, cam, dial):  # type: ignore[no-untyped-def]
    """Which of sixteen rows with centres ``w[:3]`` the dial keeps."""
    u = exponent(distance(w[0], w[1], w[2], cam), decay, dial)
    log_opacity = -(LN2 * log2(reciprocal_opacity(logit))) - u
    return gt(select(gt(splat(HUGE), decay), log_opacity, splat(ZERO)), splat(dial[LOG_THRESHOLD]))


@part
def kept(at, many, means, logits, sigma, cam, dial, dialled):  # type: ignore[no-untyped-def]
    """The bits of those of ``many`` rows from ``at`` on that are in front of the camera and not culled."""
    w = scratch(f32x16, 3)
    load_triples(means, 3 * at, w)
    depth = cam[8] * w[0] + cam[9] * w[1] + cam[10] * w[2] + cam[11]
    shown = ge(depth, splat(NEARLY * cam[NEAR]))
    if dialled:
        shown = both(shown, survives(w, load(logits, at), load(sigma, at), cam, dial))
    return bits_of(shown) & ((uint64(1) << uint64(many)) - uint64(1))


@kernel
def mark_kept(worker, workers, means, logits, sigma, cam, dial, out):  # type: ignore[no-untyped-def]
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
def drawn(rows, logits, sigma, growth, cam, dial, dialled, grows, w):  # type: ignore[no-untyped-def]
    """The drawn opacities of sixteen rows, whose centres and logarithms of scales ``w`` holds; makes these scales."""
    values = scratch(float32, 48)
    for lane in range(16):
        values[lane] = logits[rows[lane]]
    opacity = ONE / reciprocal_opacity(load(values, 0))
    size = splat(ZERO)
    if dialled:
        for lane in range(16):
            values[16 + lane] = sigma[rows[lane]]
        d = distance(w[MEAN], w[MEAN + 1], w[MEAN + 2], cam)
        decay = load(values, 16)
        opacity = opacity * exp2(-(LOG2E * exponent(d, decay, dial)))
        if dial[SOFT] > ZERO:
            fade = TWO * (opacity / splat(dial[THRESHOLD])) - TWO
            fade = select(gt(splat(HUGE), decay), vmin(vmax(fade, splat(ZERO)), splat(ONE)), splat(ONE))
            opacity = opacity * fade
        if grows:
            for lane in range(16):
                values[32 + lane] = growth[rows[lane]]
            size = load(values, 32) * log2(vmax(d * dial[GROWTH_RATE], splat(ONE)))
            size = vmin(splat(LOG2_GROWTH_MAX), vmax(splat(-LOG2_GROWTH_MAX), size))  # NaN stays, and is not drawn
    for k in range(SCALE, SCALE + 3):
        w[k] = exp2(vmin(w[k] * LOG2E + size, splat(FARTHEST_EXPONENT)))
    return opacity


@kernel
def project_dialled(  # type: ignore[no-untyped-def]
    worker, workers, means, quats, log_scales, logits, sigma, growth, sh0, shN, degree, cam, dial, records, depths, ids,
    counts,
):  # fmt: skip
    """``project.project`` of Gaussians as they are stored, at one dial value.

    ``sigma`` and ``growth`` may be empty: then there is no dial, or no growth.
    """
    n, spare, dialled, grows = len(logits), len(logits) + worker, len(sigma) > 0, len(growth) > 0
    first, last = n * worker // workers, n * (worker + 1) // workers
    means, quats, log_scales, logits = pointer(means), pointer(quats), pointer(log_scales), pointer(logits)
    sigma, growth, sh0, shN = pointer(sigma), pointer(growth), pointer(sh0), pointer(shN)
    cam, dial, records, depths, ids = pointer(cam), pointer(dial), pointer(records), pointer(depths), pointer(ids)
    w, rows, queue = scratch(f32x16, WORKSPACE), scratch(int64, 16), scratch(int64, 32)
    last_means, last_logits, last_sigma = scratch(float32, 48), scratch(float32, 16), scratch(float32, 16)
    i = packed = first
    queued = 0
    while i < last or queued > 0:
        while i < last and queued < 16:
            if i + 16 <= n:
                bits = kept(i, min(last - i, 16), means, logits, sigma, cam, dial, dialled)
            else:  # from a copy: no vector may reach beyond an array
                for k in range(n - i):
                    last_logits[k] = logits[i + k]
                    if dialled:
                        last_sigma[k] = sigma[i + k]
                    for axis in range(3):
                        last_means[3 * k + axis] = means[3 * (i + k) + axis]
                bits = kept(0, last - i, last_means, last_logits, last_sigma, cam, dial, dialled)
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
        load_stored(means, quats, log_scales, rows, w)
        opacity = drawn(rows, logits, sigma, growth, cam, dial, dialled, grows, w)
        packed = add_records(rows, filled, packed, spare, means, opacity, cam, w, records, depths, ids)
    counts[worker] = color(first, packed - first, means, sh0, shN, degree, cam, records, depths, ids)
