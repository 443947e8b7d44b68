"""Adam on selected rows, sixteen at a time."""

from numba import float32, int64

from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.elementary import vsqrt
from clod_adapter._kernels.pointers import load_rows, pointer, scratch, store_rows
from clod_adapter._kernels.simd import f32x16, load

ONE = float32(1)


@part
def find_rows(mask, i, end, rows):
    """Lists up to sixteen selected rows from ``i`` on; returns their number and the row to continue from."""
    found = 0
    while i < end and found < 16:
        rows[found] = i
        found += mask[i]  # no branch: half of the predictions would fail
        i += 1
    return found, i


@part
def step_columns(parameter, first, second, gradient, rows, width, at, many, lanes, length, correction, constants):
    """Steps the columns from ``at`` on, ``many`` of them, of sixteen rows."""
    beta1, beta2, epsilon = constants
    load_rows(parameter, rows, width, at, many, lanes, 0)
    load_rows(first, rows, width, at, many, lanes, 16)
    load_rows(second, rows, width, at, many, lanes, 32)
    load_rows(gradient, rows, width, at, many, lanes, 48)
    for k in range(many):
        g = lanes[48 + k]
        m = beta1 * lanes[16 + k] + (ONE - beta1) * g
        v = beta2 * lanes[32 + k] + (ONE - beta2) * g * g
        lanes[16 + k], lanes[32 + k] = m, v
        lanes[k] = lanes[k] - load(length, 0) * m / (vsqrt(v) * load(correction, 0) + epsilon)
    store_rows(parameter, rows, width, at, many, lanes, 0)
    store_rows(first, rows, width, at, many, lanes, 16)
    store_rows(second, rows, width, at, many, lanes, 32)


@kernel
def adam_rows(
    worker, workers, parameter, first, second, gradient, mask, steps, counted, corrections, units, rate, beta1, beta2,
    epsilon,
):  # fmt: skip
    """Updates the rows of ``parameter [N, width]`` and of its moments where ``mask [N]`` is set, with ``gradient``.

    ``steps[row]`` counts the updates of the row: ``counted``, 1 or 0, is added first. For n updates
    ``corrections[0, n]`` is ``1 / (1 - beta1^n)`` and ``corrections[1, n]`` is ``1 / sqrt(1 - beta2^n)``; the last
    entry holds for all larger n. ``units``, ``[N]`` or ``[1]`` for all, multiplies a row's rate.
    """
    width, most, rate = parameter.shape[1], corrections.shape[1] - 1, float32(rate)
    each = int64(len(units) > 1)
    i, end = len(parameter) * worker // workers, len(parameter) * (worker + 1) // workers
    lanes, rows = scratch(f32x16, 64), scratch(int64, 16)
    length, correction = scratch(float32, 16), scratch(float32, 16)
    parameter, first, second, gradient = pointer(parameter), pointer(first), pointer(second), pointer(gradient)
    constants = float32(beta1), float32(beta2), float32(epsilon)
    while i < end:
        found, i = find_rows(mask, i, end, rows)
        if found == 0:
            break
        for lane in range(16):
            if lane < found:
                steps[rows[lane]] += counted
            else:
                rows[lane] = rows[0]
            count = min(steps[rows[lane]], most)
            length[lane] = rate * units[each * rows[lane]] * corrections[0, count]
            correction[lane] = corrections[1, count]
        # Constant widths, so that the compiler simplifies the transpositions.
        if width == 1:
            step_columns(parameter, first, second, gradient, rows, 1, 0, 1, lanes, length, correction, constants)
        elif width == 3:
            step_columns(parameter, first, second, gradient, rows, 3, 0, 3, lanes, length, correction, constants)
        elif width == 4:
            step_columns(parameter, first, second, gradient, rows, 4, 0, 4, lanes, length, correction, constants)
        else:
            for at in range(0, width, 16):
                many = min(width - at, 16)
                step_columns(
                    parameter, first, second, gradient, rows, width, at, many, lanes, length, correction, constants
                )
