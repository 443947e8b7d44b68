"""Adapting in blocks: differences at block borders, and peak memory.

    python benchmarks/blocks.py seams                  # hours on two cores; --iters 300 for a quick look
    python benchmarks/blocks.py memory                 # 2 million Gaussians, 60 photographs of 960x540

``seams`` adapts a capture whole, whole with another seed, and in a fixed number of blocks. It compares each with the
photographs and with the first at s = 1, 3, 5 on the held-out views: on all pixels, and on the pixels at a border, where
no block contributes SOLE. ``memory`` runs the command on a synthetic city with and without --memory.
"""

from __future__ import annotations

import json
import math
import tempfile
import time
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

import clod_adapter as clod
from city import write_city
from clod_adapter.blocks.divide import Division, divide
from clod_adapter.blocks.targets import target_image
from clod_adapter.blocks.train import adapt_block, merge
from clod_adapter.initialization.importance import initialize, usable_views
from common import COMMAND, Process, append, arguments, checkpoint, photographs

import torch

DIALS = (1.0, 3.0, 5.0)
SOLE = 0.9
COUNT, IMAGES, ITERS, LIMITS = 2_000_000, 60, 40, ("none", "8GB", "3.5GB")  # of the city


def db(error: float) -> float:
    return -10 * math.log10(max(error, 1e-10))


@torch.no_grad()
def borders(division: Division, views: tuple[clod.View, ...]) -> list[torch.Tensor]:
    """For each view ``[H, W]`` bool: no block has SOLE of the pixel. By ``target`` of a white photograph on black."""
    black = division.initial.replace(sh0=torch.full_like(division.initial.sh0, -10), shN=division.initial.shN[:, :0])
    found = []
    for view in views:
        white, largest = clod.View(view.camera, torch.full_like(view.image, 255)), torch.zeros(view.image.shape[:2])
        for block in range(division.count):
            rows = division.rows(block)
            ordered = black.select(torch.cat([rows, (division.block != block).nonzero()[:, 0]]))
            largest = largest.maximum(target_image(ordered, len(rows), white)[..., 0] / 255)
        found.append(largest < SOLE)
    return found


@torch.no_grad()
def compare(
    some: clod.Gaussians, whole: clod.Gaussians, views: tuple[clod.View, ...], masks: list[torch.Tensor]
) -> list[dict[str, Any]]:
    """A row a dial value; PSNR as the mean over views, of border pixels over all of them together."""
    rows = []
    for s in DIALS:
        ours, theirs, between, kept = [], [], [], []
        border = torch.zeros(4, dtype=torch.float64)
        for view, mask in zip(views, masks, strict=True):
            one, other = clod.render(some, view.camera, s), clod.render(whole, view.camera, s)
            a, b, photograph = one.image.clamp(0, 1), other.image.clamp(0, 1), view.image / 255
            errors = [(x - y).square().mean(2) for x, y in ((a, photograph), (b, photograph), (a, b))]
            for values, error in zip((ours, theirs, between), errors, strict=True):
                values.append(db(float(error.mean())))
            kept.append((float(one.kept.float().mean()), float(other.kept.float().mean())))
            border += torch.tensor([*(float(e[mask].double().sum()) for e in errors), float(mask.sum())])
        difference = [a - b for a, b in zip(ours, theirs, strict=True)]
        at_border = [db(float(border[k] / border[3].clamp(min=1))) for k in range(3)]
        mean = [sum(values) / len(values) for values in (ours, difference, between)]
        rows.append({
            "virtual_scale": s, "psnr": mean[0], "difference": mean[1], "worst": min(difference), "between": mean[2],
            "border_psnr": at_border[0], "border_difference": at_border[0] - at_border[1],
            "border_between": at_border[2],
            "kept_share": sum(k for k, _ in kept) / len(kept), "whole_kept_share": sum(k for _, k in kept) / len(kept),
        })  # fmt: skip
    return rows


def seams(args: Namespace) -> None:
    for name in args.scenes:
        base, scene = checkpoint(name), photographs(name)
        config, views = clod.AdaptConfig(iters=args.iters), usable_views(base.gaussians, scene.train)
        began = time.perf_counter()
        whole = clod.adapt(base.gaussians, scene, config).gaussians
        seconds = time.perf_counter() - began
        again = clod.adapt(base.gaussians, scene, replace(config, seed=1)).gaussians
        for count in args.blocks:
            division = divide(initialize(base.gaussians, views, config), views, config, count)
            masks = borders(division, scene.test)
            share = float(torch.stack([mask.float().mean() for mask in masks]).mean())
            about = {"what": "seams", "scene": name, "iters": args.iters, "blocks": count, "border_pixels": share}
            if count == args.blocks[0]:
                row = {"label": "whole, another seed", "seconds": seconds}
                append("blocks.jsonl", {**about, **row, "rows": compare(again, whole, scene.test, masks)})
            after = None
            for number in (1, 2):
                began = time.perf_counter()
                parts = [adapt_block(division, views, config, k, after=after)[0] for k in range(count)]
                after = merge(division, parts)
                row = {"label": f"pass {number}", "seconds": time.perf_counter() - began}
                row |= {"steps": [part.steps for part in parts]}
                append("blocks.jsonl", {**about, **row, "rows": compare(after, whole, scene.test, masks)})


def memory(_: Namespace) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "city"
        write_city(folder, COUNT, IMAGES, 960, 540)
        for limit in LIMITS:
            words = [folder / "city.ply", "--images", folder, "--iters", ITERS, "--quiet"]
            words += ["--out", Path(temporary) / "out.ply", *(() if limit == "none" else ("--memory", limit))]
            process = Process([*COMMAND, *words, "--json"])
            found = json.loads(process.out)
            row = {"what": "memory", "count": COUNT, "images": IMAGES, "memory": limit, "iters": ITERS}
            row |= {"peak_bytes": process.peak_bytes, "seconds": process.seconds}
            row |= {"plan": found.get("memory"), "steps": found["steps"], "rows": found["rows"]}
            append("blocks.jsonl", row | {"times": found["seconds"]})


def main() -> None:
    parser = arguments(__doc__)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("seams")
    one.add_argument("--scenes", nargs="+", default=["plush_half", "bonsai146"])
    one.add_argument("--blocks", type=int, nargs="+", default=[4, 8])
    one.add_argument("--iters", type=int, default=clod.AdaptConfig().steps)
    one.set_defaults(run=seams)
    commands.add_parser("memory").set_defaults(run=memory)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
