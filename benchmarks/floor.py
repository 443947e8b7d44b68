"""The time of the blending against a lower bound from the processor's peak rate.

    python benchmarks/floor.py [--record]

Counts the blended pairs of a Gaussian and a pixel, and the blocks of 4x4 pixels that are visited for them; measures the
peak rate of vector operations (independent multiply-adds of 16 floats, all threads); and divides the vector operations
of the blending loops, counted in their source, by that rate. ``floor_ms`` is the time of the blended pairs alone, 16 to
a vector; ``blocks_ms`` that of the blocks, in which some lanes are idle. ``measured_ms`` is measured in the same run.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from statistics import median
from typing import Any

import clod_adapter  # noqa: F401  # before torch: it sets how OpenMP's threads wait

# isort: split
import agreement
import contenders
import numpy as np
import torch
import workloads
from common import append, arguments
from numba import float32

from clod_adapter._kernels import threads
from clod_adapter._kernels.compiling import kernel
from clod_adapter._kernels.pointers import scratch
from clod_adapter._kernels.simd import f32x16, fma, splat, store

FILE = "floor.jsonl"
THREADS = 2
CHAINS = 12  # enough to hide a multiply-add's latency on every pipe
# Vector operations a block, as the loops of _kernels/blend.py stand: offsets 2, exponent 5, exp2 11, bounds and
# decisions 8, transmittance and weight 3, colour 3; the gradient adds v . colour 3, sums of the colour 3,
# remainder 2, dL/dalpha 5, moments 8. Loads and stores are not counted.
OPERATIONS = 32, 50


@kernel
def multiply_add(worker, workers, turns, out):  # type: ignore[no-untyped-def]
    """CHAINS independent multiply-adds, ``turns`` times."""
    x = scratch(f32x16, CHAINS)
    for k in range(CHAINS):
        x[k] = splat(float32(worker + k))
    a, b = splat(float32(0.999)), splat(float32(0.001))
    for _ in range(turns):
        for k in range(CHAINS):
            x[k] = fma(x[k], a, b)
    for k in range(CHAINS):
        store(out, 16 * (CHAINS * worker + k), x[k])


def peak(turns: int = 20_000_000) -> float:
    """Vector operations a second, the best of five."""
    out, rates = np.zeros(16 * CHAINS * THREADS, np.float32), []
    threads.run(multiply_add, THREADS, 1, out)
    for _ in range(5):
        began = time.perf_counter()
        threads.run(multiply_add, THREADS, turns, out)
        rates.append(THREADS * turns * CHAINS / (time.perf_counter() - began))
    return max(rates)


def row(name: str, draw: Callable[[], torch.Tensor], pairs: int, rate: float, repeats: int = 15) -> dict[str, Any]:
    """Counts, floors and measured times of one picture and its gradient."""
    times: dict[str, list[float]] = defaultdict(list)
    run = threads.run

    def timed(function: Callable[..., Any], *arguments: Any) -> None:
        began = time.perf_counter()
        run(function, *arguments)
        times[function.__name__].append((time.perf_counter() - began) * 1e3)

    threads.run = timed
    try:
        for _ in range(repeats):
            image = draw()
            blocks = int(np.bitwise_count(image.grad_fn.frame.masks).sum())
            image.sum().backward()
    finally:
        threads.run = run
    measured = {what: round(median(times[what][2:]), 2) for what in ("blend", "blend_gradient")}

    def milliseconds(vectors: float) -> dict[str, float]:
        return {what: round(vectors * ops / rate * 1e3, 2) for what, ops in zip(measured, OPERATIONS, strict=True)}

    return {
        "scene": name, "pairs": pairs, "blocks": blocks, "lanes_used": round(pairs / (16 * blocks), 3),
        "operations": dict(zip(measured, OPERATIONS, strict=True)), "peak_operations_per_s": round(rate),
        "floor_ms": milliseconds(pairs / 16), "blocks_ms": milliseconds(blocks), "measured_ms": measured,
    }  # fmt: skip


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    args = parser.parse_args()
    torch.set_num_threads(THREADS)
    for name in workloads.SIZES:
        scene = workloads.make(name)
        found = row(name, contenders.ours(scene)[0], agreement.count_pairs(scene), peak())
        print(found, flush=True)
        if args.record:
            append(FILE, {"benchmark": "floor", "threads": THREADS, **found})


if __name__ == "__main__":
    main()
