"""Adam on selected rows, sixteen numbers at a time."""

from numba import float32, int64

from clod_adapter._kernels.compiling import kernel
from clod_adapter._kernels.elementary import bits_of, vsqrt
from clod_adapter._kernels.pointers import load, load_where, pointer, scratch, share, store_where
from clod_adapter._kernels.simd import fma, gt, splat

# numbers of sixteen rows: at most the harmonics of degree 3, the highest that Gaussians have
ROOM = 16 * 45


@kernel
def adam_rows(
    worker,
    workers,
    parameter,
    first,
    second,
    gradient,
    mask,
    steps,
    counted,
    corrections,
    units,
    rate,
    beta1,
    beta2,
    epsilon,
):
    """Updates the rows of ``parameter [N, width]`` and of its moments where ``mask [N]`` is set,
    with ``gradient``.

    ``steps[row]`` counts the updates of the row: ``counted``, 1 or 0, is added first. For n updates
    ``corrections[0, n]`` is ``1 / (1 - beta1^n)`` and ``corrections[1, n]`` is
    ``1 / sqrt(1 - beta2^n)``; the last entry holds for all larger n. ``units``, ``[N]`` or ``[1]``
    for all, multiplies a row's rate.
    """
    width = parameter.shape[1]
    most = corrections.shape[1] - 1
    rate = float32(rate)
    stride = int64(len(units) > 1)
    beta1 = splat(float32(beta1))
    beta2 = splat(float32(beta2))
    epsilon = float32(epsilon)
    rest1 = 1 - beta1
    rest2 = 1 - beta2
    begin, end = share(worker, workers, len(parameter))
    lengths = scratch(float32, ROOM)
    factors = scratch(float32, ROOM)
    parameter = pointer(parameter)
    gradient = pointer(gradient)
    first = pointer(first)
    second = pointer(second)
    for start in range(begin, end, 16):
        stop = min(start + 16, end)
        any_marked = False
        for row in range(start, stop):
            any_marked |= mask[row]
        if not any_marked:
            continue
        for k in range(16 * width):
            factors[k] = 0
        for row in range(start, stop):
            if mask[row]:
                steps[row] += counted
                count = min(steps[row], most)
                length = rate * units[stride * row] * corrections[0, count]
                factor = corrections[1, count]
                for k in range(width * (row - start), width * (row - start + 1)):
                    lengths[k] = length
                    factors[k] = factor
        for k in range(0, 16 * width, 16):
            factor = load(factors, k)
            at = width * start + k
            chosen = gt(factor, 0)
            if bits_of(chosen):
                g = load_where(chosen, gradient, at)
                m = fma(beta1, load_where(chosen, first, at), rest1 * g)
                v = fma(beta2, load_where(chosen, second, at), rest2 * g * g)
                x = load_where(chosen, parameter, at) - load(lengths, k) * m / (
                    vsqrt(v) * factor + epsilon
                )
                store_where(chosen, first, at, m)
                store_where(chosen, second, at, v)
                store_where(chosen, parameter, at, x)
