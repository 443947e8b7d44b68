"""The count term's gradient at typical distances (``training/target_count.py``), sixteen Gaussians at a time."""

from numba import float32, uint64

from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.conventions import LOG2E, LOG_THRESHOLD, ONE, TWO, ZERO
from clod_adapter._kernels.dial import LN2, exponent, reciprocal_opacity
from clod_adapter._kernels.elementary import bits_of, exp2, log2, ones, vabs
from clod_adapter._kernels.pointers import pointer, scratch
from clod_adapter._kernels.simd import f32x16, gt, load, select, splat, store, vmax


@part
def load_sixteen(values, i, last):
    """The rows from ``i`` on; beyond the last, that one again."""
    if i + 16 <= last:
        return load(values, i)
    rest = scratch(float32, 16)
    for lane in range(16):
        rest[lane] = values[min(i + lane, last - 1)]
    return load(rest, 0)


@part
def load_logs(i, last, logits, sigma, d, dial, w):
    """``w[0]`` log a'' less the threshold's, and ``w[1]`` u, of up to sixteen rows from ``i`` on."""
    w[0], w[1], w[2] = load_sixteen(logits, i, last), load_sixteen(sigma, i, last), load_sixteen(d, i, last)
    w[1] = exponent(w[2], w[1], dial)
    w[0] = -(LN2 * log2(reciprocal_opacity(w[0]))) - w[1] - splat(dial[LOG_THRESHOLD])


@kernel
def count_kept(worker, workers, logits, sigma, d, dial, counts):
    """``counts[worker]``: how many of this worker's rows are kept at the distances ``d [N]``."""
    first, last = len(logits) * worker // workers, len(logits) * (worker + 1) // workers
    logits, sigma, d, dial, w = pointer(logits), pointer(sigma), pointer(d), pointer(dial), scratch(f32x16, 3)
    total = 0
    for i in range(first, last, 16):
        load_logs(i, last, logits, sigma, d, dial, w)
        bits = bits_of(gt(w[0], splat(ZERO)))
        if i + 16 > last:
            bits &= (uint64(1) << uint64(last - i)) - uint64(1)
        total += ones(bits)
    counts[worker] = total


@kernel
def count_slope(worker, workers, logits, sigma, d, dial, temperature, lift, penalty, out):
    """``out [N]``: ``penalty q (1 - q) max(2 u, 1)``; where a row is culled, at least ``penalty lift``.

    ``q = sigmoid((log a'' - log(tau s)) / temperature)``.
    """
    first, last = len(logits) * worker // workers, len(logits) * (worker + 1) // workers
    logits, sigma, d, dial, out = pointer(logits), pointer(sigma), pointer(d), pointer(dial), pointer(out)
    w, rest = scratch(f32x16, 3), scratch(float32, 16)
    factor, least, scale = float32(LOG2E / temperature), float32(lift), float32(penalty)
    for i in range(first, last, 16):
        load_logs(i, last, logits, sigma, d, dial, w)
        odds = exp2(-(vabs(w[0]) * factor))
        slope = odds / ((ONE + odds) * (ONE + odds)) * vmax(TWO * w[1], splat(ONE))
        value = scale * select(gt(w[0], splat(ZERO)), slope, vmax(slope, splat(least)))
        if i + 16 <= last:
            store(out, i, value)
        else:
            store(rest, 0, value)
            for lane in range(last - i):
                out[i + lane] = rest[lane]
