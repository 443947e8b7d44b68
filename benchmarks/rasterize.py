"""Times of the CPU rasterizer and of two others, and its agreement with a float64 reference.

    python benchmarks/rasterize.py                     # times on W1 and W2, of fewer Gaussians too
    python benchmarks/rasterize.py --skip-gsplat
    python benchmarks/rasterize.py --accuracy          # image and gradients against float64 instead
    python benchmarks/rasterize.py --extreme           # times of scenes that are unlike any capture instead

The others are the yardstick (a hand-written C++ kernel in the shared folder, built with g++) and gsplat (see
``peer_gsplat.py``); fields of an absent one are null. Each runs in its own process with 2 threads, all in turn step by
step, so that drift of the machine affects all alike. Times are medians in milliseconds: ``forward_ms`` and ``both_ms``
of one step with all gradients, ``render_ms`` of a frame without gradients. Memory is the peak of the steps beyond a
warm process, gradients included.
"""

from __future__ import annotations

import os
import sys
import tempfile
from argparse import Namespace
from pathlib import Path
from statistics import median
from typing import Any

import clod_adapter  # noqa: F401  # before torch: it sets how OpenMP's threads wait

# isort: split
import agreement
import contenders
import peer_gsplat
import torch
import workloads
from common import ROOT, append, arguments
from contenders import SHARES, THREADS, Worker

FILE = "rasterize.jsonl"
YARDSTICK = Path(os.environ.get("CLOD_YARDSTICK", ROOT.parent / "shared" / "yardstick"))
WARM = 2  # first repeats that do not count
GSPLAT_REPEATS = {"W1": 3, "W2": 1}  # it takes seconds
EXTREME_REPEATS = 5
Row = dict[str, Any]


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("--workloads", nargs="+", choices=workloads.SIZES, default=list(workloads.SIZES))
    parser.add_argument("--repeats", type=int, default=15, help="of ours and the yardstick (default: %(default)s)")
    parser.add_argument("--skip-gsplat", action="store_true")
    parser.add_argument("--yardstick", type=Path, default=YARDSTICK, metavar="DIR", help="default: $CLOD_YARDSTICK")
    modes = parser.add_mutually_exclusive_group()
    modes.add_argument("--accuracy", action="store_true", help="agreement with float64 instead of times; minutes")
    modes.add_argument("--extreme", action="store_true", help="times of extreme scenes instead, ours only")
    args = parser.parse_args()
    torch.set_num_threads(THREADS)
    if args.accuracy:
        kind, table, rows = "accuracy", agreement.table, [agreement.compare(name) for name in args.workloads]
    elif args.extreme:
        kind, table, rows = "extreme", extreme_table, extreme()
    else:
        kind, table, rows = "speed", speed_table, speed(args)
    print(table(rows), flush=True)
    for row in rows if args.record else []:
        append(FILE, {"benchmark": "rasterize", "kind": kind, **row})


def speed(args: Namespace) -> list[Row]:
    """All times of each workload."""
    with tempfile.TemporaryDirectory() as folder:
        library = contenders.build_yardstick(args.yardstick, Path(folder))
        missing = "--skip-gsplat" if args.skip_gsplat else peer_gsplat.available()
        if missing:
            print(f"gsplat is left out: {missing}", file=sys.stderr)
        rows = []
        for name in args.workloads:
            peers = {"ours": Worker("ours", contenders.our_jobs, name)}
            if library:
                peers["yardstick"] = Worker("yardstick", contenders.yardstick_jobs, name, args.yardstick, library)
            if not missing:
                peers["gsplat"] = Worker("gsplat", contenders.gsplat_jobs, name)
            rows.append(time_workload(name, peers, args.repeats))
            for worker in peers.values():
                worker.close()
    return rows


def time_workload(name: str, peers: dict[str, Worker], repeats: int) -> Row:
    """Steps of all peers in turn, then our frames of fewer Gaussians."""
    steps: dict[str, list[Any]] = {peer: [] for peer in peers}
    for repeat in range(repeats + WARM):
        for peer, worker in peers.items():
            if peer != "gsplat" or repeat < GSPLAT_REPEATS[name]:
                steps[peer].append(worker("step"))
    memory = {peer: worker("memory") for peer, worker in peers.items()}
    pairs = peers["yardstick"]("pairs") if "yardstick" in peers else None
    frames, kept = zip(*([peers["ours"](job) for job in ("frame", "kept")] for _ in range(repeats + WARM)), strict=True)
    if None in [*steps["ours"], *frames, *kept]:
        sys.exit(f"our own process ended early on {name}")
    count, width, height, _ = workloads.SIZES[name]
    row = {"workload": name, "gaussians": count, "width": width, "height": height, "pairs": pairs, "repeats": repeats}
    for prefix, peer in (("", "ours"), ("yardstick_", "yardstick"), ("gsplat_", "gsplat")):
        for k, what in enumerate(("forward", "both")):
            times = [step[k] for step in steps.get(peer, []) if step]
            row[f"{prefix}{what}_ms"] = middle(times, peer)
            row[f"{prefix}{what}_best_ms"] = round(min(times), 2) if times else None
        row[prefix + "memory_mb"] = memory.get(peer)
    row["render_ms"] = middle(frames, "ours")
    for peer in ("yardstick", "gsplat"):
        for what in ("forward", "both"):
            theirs = row[f"{peer}_{what}_ms"]
            row[f"{what}_ratio_{peer}"] = theirs and round(row[f"{what}_ms"] / theirs, 3)
    return {**row, "kept": kept_rows(kept)}


def middle(times: list[float], peer: str) -> float | None:
    """The median, without the first repeats where there are many."""
    counted = times if peer == "gsplat" else times[WARM:]
    return round(median(counted), 2) if counted else None


def kept_rows(frames: list[list[float]]) -> list[Row]:
    """Frames of the most opaque Gaussians, and their share of the full frame's time."""
    ways = [(way, share) for way in ("rows removed", "opacity 0") for share in SHARES]
    times = [middle(list(column), "ours") for column in zip(*frames, strict=True)]
    return [
        {"way": way, "share": share, "ms": ms, "fraction": round(ms / times[0], 3)}
        for (way, share), ms in zip(ways, times, strict=True)
    ]


def speed_table(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        pairs = "" if row["pairs"] is None else f", {row['pairs'] / 1e6:.1f} M pairs of Gaussian and pixel"
        lines += [f"{row['workload']}: {row['gaussians']:,} Gaussians, {row['width']}x{row['height']}{pairs}"]
        lines += [f"  {'':10} {'forward ms':>10} {'best':>10} {'both ms':>10} {'best':>10} {'memory MB':>10}"]
        for peer, prefix in (("ours", ""), ("yardstick", "yardstick_"), ("gsplat", "gsplat_")):
            fields = ("forward_ms", "forward_best_ms", "both_ms", "both_best_ms", "memory_mb")
            cells = [row[prefix + field] for field in fields]
            lines += [f"  {peer:10} " + " ".join(f"{'-' if cell is None else cell:>10}" for cell in cells)]
        ratios = [f"{what} {row[f'{what}_ratio_{peer}']} of {peer}'s" for peer in ("yardstick", "gsplat")
                  for what in ("forward", "both") if row[f"{what}_ratio_{peer}"]]  # fmt: skip
        lines += [f"  ours takes {', '.join(ratios)}"] if ratios else []
        lines += [f"  a frame without gradients: {row['render_ms']} ms; of the most opaque Gaussians alone:"]
        lines += [f"    {k['share']:5.0%} {k['way']:13} {k['ms']:8.2f} ms {k['fraction']:5.0%}" for k in row["kept"]]
    return "\n".join(lines)


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


def extreme_table(rows: list[Row]) -> str:
    times = ("forward_ms", "both_ms", "times_w1", "ns_per_gaussian", "ns_per_pixel")
    fields = ("gaussians", *times, "pairs", "ns_per_pair")
    titles = [field.replace("_per_", "/").replace("_", " ") for field in fields]
    lines = [f"{'scene':32}" + "".join(f"{title:>13}" for title in titles)]
    for row in rows:
        cells = ["-" if row[field] is None else f"{row[field]:,}" for field in fields]
        lines.append(
            f"{row['scene']:32}" + "".join(f"{cell:>13}" for cell in cells) + "  NOT FINITE" * (not row["finite"])
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
