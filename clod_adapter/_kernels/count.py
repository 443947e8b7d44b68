"""The count term's gradient at typical distances (``training/target_count.py``), sixteen Gaussians
at a time.
"""

from numba import float32

from clod_adapter._kernels.compiling import kernel
from clod_adapter._kernels.dial import squared_reach
from clod_adapter._kernels.pointers import load_some, pointer, share, store_some
from clod_adapter._kernels.simd import gt, select, vmax, vmin

DOUBLINGS = 5  # of the exponent 1 of t: 2^5 is target_count.SHARPNESS


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
        distance = load_some(d, i, last - i)
        far2 = distance * distance * square
        reach2 = squared_reach(load_some(sigma, i, last - i), far2)
        odds = vmin(far2 / reach2, reach2 / far2)
        for _ in range(DOUBLINGS - 1):
            odds = odds * odds
        slope = odds / ((1 + odds) * (1 + odds))
        store_some(out, i, last - i, scale * select(gt(reach2, far2), slope, vmax(slope, least)))
