"""Times of the CPU rasterizer and of a C++ baseline; or its agreement with a float64 reference; or extreme scenes.

The baseline is the yardstick, a hand-written C++ kernel outside the repository, built with g++; its fields are null
where it is absent. Each runs in its own process with 2 threads, in turn step by step, so that drift of the machine
affects both alike. Times are medians in milliseconds: ``forward_ms`` and ``both_ms`` of one step with all gradients,
``render_ms`` of a frame without gradients. Memory is the peak of the steps beyond a warm process, gradients included.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import agreement
import contenders
import workloads
from common import ROOT, Row, append, arguments
from contenders import SHARES, THREADS, Worker

import torch

FILE = "rasterize.jsonl"
YARDSTICK = Path(os.environ.get("CLOD_YARDSTICK", ROOT.parent / "shared" / "yardstick"))
WARM = 2  # first repeats that do not count
REPEATS = 15
EXTREME_REPEATS = 5


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    modes = parser.add_mutually_exclusive_group()
    modes.add_argument("--accuracy", action="store_true", help="agreement with float64 instead of times; minutes")
    modes.add_argument("--extreme", action="store_true", help="times of extreme scenes instead, ours only")
    args = parser.parse_args()
    torch.set_num_threads(THREADS)
    if args.accuracy:
        kind, rows = "accuracy", [agreement.compare(name) for name in workloads.SIZES]
    elif args.extreme:
        kind, rows = "extreme", extreme()
    else:
        kind, rows = "speed", speed()
    for row in rows:
        print(json.dumps(row, indent=1), flush=True)
        if args.record:
            append(FILE, {"benchmark": "rasterize", "kind": kind, **row})


def speed() -> list[Row]:
    """All times of each workload."""
    with tempfile.TemporaryDirectory() as folder:
        library = contenders.build_yardstick(YARDSTICK, Path(folder))
        rows = []
        for name in workloads.SIZES:
            workers = {"ours": Worker(contenders.our_jobs, name)}
            if library:
                workers["yardstick"] = Worker(contenders.yardstick_jobs, name, YARDSTICK, library)
            rows.append(time_workload(name, workers))
            for worker in workers.values():
                worker.pool.shutdown()
    return rows


def time_workload(name: str, workers: dict[str, Worker]) -> Row:
    """Steps of all rasterizers in turn, then our frames of fewer Gaussians."""
    turns = range(REPEATS + WARM)
    steps = [{peer: worker("step") for peer, worker in workers.items()} for _ in turns]
    memory = {peer: worker("memory") for peer, worker in workers.items()}
    pairs = workers["yardstick"]("pairs") if "yardstick" in workers else None
    frames, kept = zip(*([workers["ours"](job) for job in ("frame", "kept")] for _ in turns), strict=True)
    if None in [*(step["ours"] for step in steps), *frames, *kept]:
        sys.exit(f"our own process ended early on {name}")
    count, width, height, _ = workloads.SIZES[name]
    row = {"workload": name, "gaussians": count, "width": width, "height": height, "pairs": pairs, "repeats": REPEATS}
    for prefix, peer in (("", "ours"), ("yardstick_", "yardstick")):
        taken = [step[peer] for step in steps if step.get(peer)]
        for k, what in enumerate(("forward", "both")):
            times = [step[k] for step in taken]
            row[f"{prefix}{what}_ms"] = middle(times)
            row[f"{prefix}{what}_best_ms"] = round(min(times), 2) if times else None
        row[prefix + "memory_mb"] = memory.get(peer)
    row["render_ms"] = middle(frames)
    for what in ("forward", "both"):
        theirs = row[f"yardstick_{what}_ms"]
        row[f"{what}_ratio_yardstick"] = theirs and round(row[f"{what}_ms"] / theirs, 3)
    return {**row, "kept": kept_rows(kept)}


def middle(times: Sequence[float]) -> float | None:
    """The median without the first repeats."""
    return round(median(times[WARM:]), 2) if times[WARM:] else None


def kept_rows(frames: Sequence[list[float]]) -> list[Row]:
    """Frames of the most opaque Gaussians, and their share of the full frame's time."""
    ways = [(way, share) for way in ("rows removed", "opacity 0") for share in SHARES]
    times = [middle(column) for column in zip(*frames, strict=True)]
    return [
        {"way": way, "share": share, "ms": ms, "fraction": round(ms / times[0], 3)}
        for (way, share), ms in zip(ways, times, strict=True)
    ]


def extreme() -> list[Row]:
    """A step of each extreme scene, ours, in turn with one of W1; and whether everything that comes out is finite."""
    w1, rows = workloads.make("W1"), []
    w1_draw, w1_leaves = contenders.ours(w1)
    for name, make in workloads.extremes().items():
        scene = make(w1)
        draw, leaves = contenders.ours(scene)
        steps, w1_both = [], []
        for _ in range(EXTREME_REPEATS + 1):
            w1_both.append(contenders.timed_step(w1_draw, w1_leaves, w1.weights)[1])
            steps.append(contenders.timed_step(draw, leaves, scene.weights))
        forward, both = (median(column) for column in zip(*steps[1:], strict=True))
        finite = all(leaf.grad.isfinite().all().item() for leaf in leaves) and draw().isfinite().all().item()
        count, pixels, pairs = len(scene.means), scene.camera.width * scene.camera.height, agreement.count_pairs(scene)
        rows.append({
            "scene": name, "gaussians": count, "pixels": pixels, "pairs": pairs, "forward_ms": round(forward, 2),
            "both_ms": round(both, 2), "times_w1": round(both / median(w1_both[1:]), 2), "finite": finite,
            "ns_per_gaussian": round(both * 1e6 / count, 1), "ns_per_pixel": round(both * 1e6 / pixels, 1),
            "ns_per_pair": round(both * 1e6 / pairs, 3) if pairs else None,
        })  # fmt: skip
    return rows


if __name__ == "__main__":
    main()
