"""The count term's gradient at typical distances (``training/target_count.py``), sixteen Gaussians
at a time.
"""

from numba import float32

from clod_adapter._kernels.compiling import inlined, kernel
from clod_adapter._kernels.dial import squared_reach, survives
from clod_adapter._kernels.elementary import bits_of, ones
from clod_adapter._kernels.pointers import first_lanes, load_some, pointer, share, store_some
from clod_adapter._kernels.simd import both, gt, select, vmax, vmin

DOUBLINGS = 5  # of the exponent 1 of t: 2^5 is target_count.SHARPNESS


@inlined
def load_squares(i, many, sigma, d, dial2):
    """``sigma`` and (d s)^2 of at most sixteen of ``many`` rows from ``i`` on; ``dial2`` is s^2."""
    d = load_some(d, i, many)
    return load_some(sigma, i, many), d * d * dial2


@kernel
def count_kept(worker, workers, sigma, d, dial2, counts):
    """``counts[worker]``: how many of this worker's rows are kept at the distances ``d [N]``."""
    first, last = share(worker, workers, len(sigma))
    sigma = pointer(sigma)
    d = pointer(d)
    square = float32(dial2)
    total = 0
    for i in range(first, last, 16):
        reach, far2 = load_squares(i, last - i, sigma, d, square)
        total += ones(bits_of(both(survives(reach, far2, float32(0)), first_lanes(last - i))))
    counts[worker] = total


@kernel
def count_slope(worker, workers, sigma, d, dial2, lift, penalty, out):
    """``out [N]``: ``penalty w / (1 + w)^2``, ``w = min(t, 1/t)^(2^DOUBLINGS)``; where a row is
    culled, at least ``penalty lift``.
    """
    first, last = share(worker, workers, len(sigma))
    sigma = pointer(sigma)
    d = pointer(d)
    out = pointer(out)
    square = float32(dial2)
    least = float32(lift)
    scale = float32(penalty)
    for i in range(first, last, 16):
        reach, far2 = load_squares(i, last - i, sigma, d, square)
        reach2 = squared_reach(reach, far2)
        odds = vmin(far2 / reach2, reach2 / far2)
        for _ in range(DOUBLINGS - 1):
            odds = odds * odds
        slope = odds / ((1 + odds) * (1 + odds))
        store_some(out, i, last - i, scale * select(gt(reach2, far2), slope, vmax(slope, least)))
