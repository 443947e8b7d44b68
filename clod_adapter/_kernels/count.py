"""The count term's gradient at typical distances (``training/target_count.py``), sixteen Gaussians at a time."""

from numba import float32

from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.conventions import LOG2E, ONE, TWO, ZERO
from clod_adapter._kernels.dial import LN2, LOG_THRESHOLD, exponent, reciprocal_opacity
from clod_adapter._kernels.elementary import bits_of, exp2, log2, ones, vabs
from clod_adapter._kernels.pointers import first_lanes, load_some, pointer, store_some
from clod_adapter._kernels.simd import both, gt, select, splat, vmax


@part
def load_logs(i, many, logits, sigma, d, dial):
    """log a'' less the threshold's, and u, of at most sixteen of ``many`` rows from ``i`` on."""
    u = exponent(load_some(d, i, many), load_some(sigma, i, many), dial)
    return -(LN2 * log2(reciprocal_opacity(load_some(logits, i, many)))) - u - splat(dial[LOG_THRESHOLD]), u


@kernel
def count_kept(worker, workers, logits, sigma, d, dial, counts):
    """``counts[worker]``: how many of this worker's rows are kept at the distances ``d [N]``."""
    first, last = len(logits) * worker // workers, len(logits) * (worker + 1) // workers
    logits, sigma, d, dial, total = pointer(logits), pointer(sigma), pointer(d), pointer(dial), 0
    for i in range(first, last, 16):
        log, _ = load_logs(i, last - i, logits, sigma, d, dial)
        total += ones(bits_of(both(gt(log, splat(ZERO)), first_lanes(last - i))))
    counts[worker] = total


@kernel
def count_slope(worker, workers, logits, sigma, d, dial, temperature, lift, penalty, out):
    """``out [N]``: ``penalty q (1 - q) max(2 u, 1)``; where a row is culled, at least ``penalty lift``.

    ``q = sigmoid((log a'' - log(tau s)) / temperature)``.
    """
    first, last = len(logits) * worker // workers, len(logits) * (worker + 1) // workers
    logits, sigma, d, dial, out = pointer(logits), pointer(sigma), pointer(d), pointer(dial), pointer(out)
    factor, least, scale = float32(LOG2E / temperature), float32(lift), float32(penalty)
    for i in range(first, last, 16):
        log, u = load_logs(i, last - i, logits, sigma, d, dial)
        odds = exp2(-(vabs(log) * factor))
        slope = odds / ((ONE + odds) * (ONE + odds)) * vmax(TWO * u, splat(ONE))
        store_some(out, i, last - i, scale * select(gt(log, splat(ZERO)), slope, vmax(slope, splat(least))))
