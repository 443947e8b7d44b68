"""Adam on selected rows: one pass over exactly the rows that had a gradient."""

from __future__ import annotations

import math

import numpy as np
from numba import float32

from clod_adapter._kernels.compiling import kernel


@kernel
def adam_rows(worker, workers, parameter, first, second, gradient, rows, steps, rate, beta1, beta2, epsilon):  # type: ignore[no-untyped-def]
    """Updates ``parameter[rows]`` (``[N, C]`` and its moments) with ``gradient [len(rows), C]``.

    ``steps[row]`` counts the row's own updates, this one included: its bias correction.
    """
    one = float32(1)
    width = parameter.shape[1]
    for i in range(len(rows) * worker // workers, len(rows) * (worker + 1) // workers):
        row = rows[i]
        count = float32(steps[row])
        scale = float32(rate) / (one - float32(beta1) ** count)
        correction = one / math.sqrt(one - float32(beta2) ** count)
        for c in range(width):
            g = gradient[i, c]
            m = float32(beta1) * first[row, c] + (one - float32(beta1)) * g
            v = float32(beta2) * second[row, c] + (one - float32(beta2)) * g * g
            first[row, c] = m
            second[row, c] = v
            parameter[row, c] -= scale * m / (np.sqrt(v) * correction + float32(epsilon))
