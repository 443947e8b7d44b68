"""A budget of Gaussians shared among the leaves of a streamed set, by measured errors and by counts.

    clod-adapt plush_half/pretrained.ply --images plush_half --max-sv 7 --iters 200 -o plush7.ply
    python benchmarks/lod_errors.py plush7.ply plush_half     # needs splat-transform
    python benchmarks/lod_errors.py --city 1000000            # seconds only, without splat-transform
    python benchmarks/lod_errors.py --table                   # the rows as a Markdown table

The levels are baked for the viewpoints in the model, and packed without their harmonics, since only the index is read.
Each held-out view shares each budget as a viewer does (PlayCanvas's engine 2.22), by ``errors_by_count``, its fallback,
and by ``level_errors``, from those viewpoints and from the training cameras of the capture; PSNR is against the
photographs and against the finest level. Adds a row to ``results/lod_errors.jsonl``.
"""

from __future__ import annotations

import heapq
import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import clod_adapter as clod
from city import city, city_cameras
from clod_adapter.evaluation.level_errors import VIEWS, coverage, errors_by_count, level_errors, looking
from clod_adapter.io.file_formats import write
from clod_adapter.io.formats.lod_meta import Leaf, cut_tree, cutting_options, read_leaves
from clod_adapter.io.formats.splat_transform import SplatTransform, time_limit
from clod_adapter.metrics import psnr
from common import append, arguments, photographs, print_rows

import numpy as np
import torch

FILE = "lod_errors.jsonl"
COLUMNS = ("scene", "finest", "leaves", "seconds", "packing_seconds", "budget", "count", "measured", "images")
DIALS = (1.0, 2.0, 4.0, 7.0)
BUDGETS = (0.2, 0.35, 0.5, 0.7)  # of the finest level's Gaussians
SHARES = (1.0, 0.5, 0.25, 0.12)  # of the city's Gaussians in each level


def main() -> None:
    parser = arguments(__doc__, table=lambda: print_rows(FILE, *COLUMNS))
    parser.add_argument("model", nargs="?", help="an adapted file")
    parser.add_argument("scene", nargs="?", help="its capture")
    parser.add_argument("--city", type=int, metavar="N", help="seconds for a made-up city of N Gaussians")
    args = parser.parse_args()
    if args.city:
        town = city(args.city, sh_degree=0)
        order = (town.opacities * town.scales.amax(1)).argsort(descending=True)
        levels = [town.select(order[: int(share * len(town))]) for share in SHARES]
        leaves, began = cut(levels), time.perf_counter()
        level_errors(levels, leaves, city_cameras(VIEWS, 988, 740, count=args.city))
        append(FILE, {
            "benchmark": "lod_errors", "scene": "city", "finest": len(town), "counts": [len(level) for level in levels],
            "leaves": len(leaves), "threads": torch.get_num_threads(),
            "seconds": round(time.perf_counter() - began, 1),
        })  # fmt: skip
    else:
        model = clod.load(args.model)
        levels = [clod.bake(model.gaussians, s, cameras=model.viewpoints) for s in DIALS]
        scene = photographs(args.scene)
        row, leaves, errors = measure(levels, looking(model.viewpoints, levels[-1]))
        tables = {
            "count": np.array([errors_by_count(leaf, len(levels)) for leaf in leaves]), "measured": errors,
            "images": level_errors(levels, leaves, [view.camera for view in scene.train]),
        }  # fmt: skip
        rows = budgets(levels, leaves, tables, scene.test)
        append(FILE, {"benchmark": "lod_errors", "scene": args.scene, "dials": DIALS, **row, "rows": rows})


def measure(
    levels: list[clod.Gaussians], cameras: Sequence[clod.Camera]
) -> tuple[dict[str, Any], list[Leaf], np.ndarray]:
    """A row with what it took, the leaves and their errors."""
    tool, counts = SplatTransform.find(), [len(level) for level in levels]
    with tempfile.TemporaryDirectory() as folder:
        words: list[str | Path] = [*cutting_options(sum(counts))]
        for k, level in enumerate(levels):
            write(Path(folder) / f"{k}.ply", level.without_bands(0))
            words += [Path(folder) / f"{k}.ply", "-l", str(k)]
        index = Path(folder) / "set" / "lod-meta.json"
        packing = tool.run(*words, index, timeout=time_limit(sum(counts)))
        began = time.perf_counter()
        _, leaves = read_leaves(index, [level.means.numpy() for level in levels])
    errors = level_errors(levels, leaves, cameras)
    return {
        "finest": counts[0], "counts": counts, "leaves": len(leaves), "threads": torch.get_num_threads(),
        "seconds": round(time.perf_counter() - began, 1), "packing_seconds": round(packing, 1),
    }, leaves, errors  # fmt: skip


def cut(levels: Sequence[clod.Gaussians]) -> list[Leaf]:
    """The leaves that splat-transform cuts, without packing."""
    centres = [level.means.numpy() for level in levels]
    largest = 1024 * int(cutting_options(sum(map(len, centres)))[-1])

    def node(count: int) -> dict[str, Any]:
        return {"lods": {}} if count <= largest else {"children": [node(count // 2), node(count - count // 2)]}

    tree, levels_of = node(sum(map(len, centres))), np.repeat(np.arange(len(centres)), [*map(len, centres)])
    points, starts = np.concatenate(centres), np.cumsum([0, *map(len, centres)])
    leaves = []
    for each, rows in cut_tree(tree, points, np.arange(len(points))):
        parts = tuple(rows[levels_of[rows] == level] - starts[level] for level in range(len(centres)))
        each["lods"] = {str(level): {"count": len(part)} for level, part in enumerate(parts) if len(part)}
        each["bound"] = {"min": points[rows].min(0).tolist(), "max": points[rows].max(0).tolist()}
        leaves.append(Leaf(each, parts))
    return leaves


def budgets(
    levels: Sequence[clod.Gaussians], leaves: Sequence[Leaf], tables: dict[str, np.ndarray], views: Sequence[clod.View]
) -> list[dict[str, Any]]:
    """For each budget the Gaussians spent, and both PSNR, by each table, means over the views."""
    rows = [{"budget": budget, **{name: [] for name in tables}} for budget in BUDGETS]
    for view in views:
        finest = clod.render(levels[0], view.camera).image.clamp(0, 1)
        for row in rows:
            for name, table in tables.items():
                shown = spend(leaves, table, view.camera, int(row["budget"] * len(levels[0])))
                chosen = joined([(levels[at], leaf.rows[at]) for leaf, at in zip(leaves, shown, strict=True)])
                image = clod.render(chosen, view.camera).image.clamp(0, 1)
                against = -10 * math.log10(max(float((image - finest).square().mean()), 1e-12))
                row[name].append((len(chosen), psnr(image, view.image), against))
    for row in rows:
        for name in tables:
            means = [fmean(each) for each in zip(*row[name], strict=True)]
            row[name] = dict(zip(("spent", "psnr", "psnr_finest"), (round(x, 3) for x in means), strict=True))
    return rows


def joined(parts: Sequence[tuple[clod.Gaussians, np.ndarray]]) -> clod.Gaussians:
    picked = [gaussians.select(torch.from_numpy(rows)) for gaussians, rows in parts]
    return picked[0].replace(**{
        name: torch.cat([each.tensors()[name] for each in picked]) for name in picked[0].tensors()
    })  # fmt: skip


def spend(leaves: Sequence[Leaf], errors: np.ndarray, camera: clod.Camera, budget: int) -> list[int]:
    """The level of each leaf: steps to finer levels by falling value, until one does not fit.

    A step's value is the largest error removed per Gaussian added by it and any number of the next steps, times the
    leaf's coverage. Levels that have more Gaussians and no less error than another are not used.
    """
    chains, shown, left, heap = [], [], budget, []
    for leaf, table in zip(leaves, errors, strict=True):
        counts = {level: leaf.node["lods"][str(level)]["count"] for level in leaf.levels}
        chain = list[int]()
        for level in sorted(counts, key=lambda level: (counts[level], table[level])):
            if not chain or table[level] < table[chain[-1]]:
                chain.append(level)
        chains.append((chain, counts))
        shown.append(0)
        left -= counts[chain[0]]

    def offer(number: int) -> None:
        (chain, counts), at, table = chains[number], shown[number], errors[number]
        if at + 1 < len(chain):
            now = chain[at]
            value = max((table[now] - table[to]) / (counts[to] - counts[now]) for to in chain[at + 1 :])
            heapq.heappush(heap, (-coverage(leaves[number], camera) * value, number))

    for number in range(len(leaves)):
        offer(number)
    while heap:
        _, number = heapq.heappop(heap)
        chain, counts = chains[number]
        left -= counts[chain[shown[number] + 1]] - counts[chain[shown[number]]]
        if left < 0:
            break
        shown[number] += 1
        offer(number)
    return [chain[at] for (chain, _), at in zip(chains, shown, strict=True)]


if __name__ == "__main__":
    main()
