"""Adapting in blocks against adapting whole, and in two processes against one.

    python benchmarks/blocks.py quality plush_half         # 4 and 8 blocks; --iters 300 for a quick look
    python benchmarks/blocks.py memory                     # 2 million Gaussians, 60 photographs of 960x540
    python benchmarks/blocks.py processes plush_half       # 300 views

``quality`` adapts a capture whole, whole with another seed, and in a fixed number of blocks, and compares each with the
photographs and with the first at s = 1, 3, 5 on the held-out views. ``memory`` runs the command on a synthetic town
with and without --memory. ``processes`` runs it with one view a step, with two, and with two processes of one view
each, and compares the last two files. Rows go to ``results/blocks.jsonl``.
"""

import json
import sys
import tempfile
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import clod_adapter as clod
from city import write_city
from clod_adapter.blocks.divide import divide
from clod_adapter.blocks.train import adapt_block, merge
from clod_adapter.initialization.importance import initialize, usable_views
from clod_adapter.losses import psnr
from common import COMMAND, Process, Row, append, arguments, capture, checkpoint, photographs

import torch

FILE, DIALS = "blocks.jsonl", (1.0, 3.0, 5.0)
COUNT, IMAGES, ITERS, LIMITS = 2_000_000, 60, 40, ("none", "8GB", "3.5GB")  # of the town


@torch.no_grad()
def compare(some: clod.Gaussians, whole: clod.Gaussians, views: tuple[clod.View, ...]) -> list[Row]:
    """A row a dial value: PSNR, the mean and the worst difference to that of the whole run."""
    rows = []
    for s in DIALS:
        shown = [(clod.render(some, view.camera, s), clod.render(whole, view.camera, s)) for view in views]
        pairs = [(psnr(a.image, v.image), psnr(b.image, v.image)) for (a, b), v in zip(shown, views, strict=True)]
        off = [a - b for a, b in pairs]
        rows.append({
            "virtual_scale": s, "psnr": sum(a for a, _ in pairs) / len(pairs), "difference": sum(off) / len(off),
            "worst": min(off),
            "kept_share": sum(float(a.kept.float().mean()) for a, _ in shown) / len(shown),
        })  # fmt: skip
    return rows


def quality(args: Namespace) -> None:
    for name in args.scenes:
        base, scene = checkpoint(name).gaussians, photographs(name)
        config, views = clod.AdaptConfig(iters=args.iters), usable_views(base, scene.train)
        whole = clod.adapt(base, scene, config).gaussians
        again = clod.adapt(base, scene, replace(config, seed=1)).gaussians
        about = {"what": "quality", "scene": name, "iters": args.iters}
        append(FILE, {**about, "label": "whole, another seed", "rows": compare(again, whole, scene.test)})
        for count in args.blocks:
            division, after = divide(initialize(base, views, config), views, config, count), None
            for number in (1, 2):
                parts = [adapt_block(division, views, config, k, after=after) for k in range(count)]
                after = merge(division, parts)
                row = {"blocks": count, "label": f"pass {number}", "steps": [part.steps for part in parts]}
                append(FILE, {**about, **row, "rows": compare(after, whole, scene.test)})


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
            append(FILE, row | process.cost() | {"plan": found.get("memory"), "steps": found["steps"]})


def processes(args: Namespace) -> None:
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", 2, "-m"]
    runs = {
        "one view": (COMMAND, {"iters": 300, "batch": 1}), "two views": (COMMAND, {"iters": 150, "batch": 2}),
        "two processes": ((*torchrun, "clod_adapter"), {"iters": 150, "batch": 2}),
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        for name in args.scenes:
            found, files = {}, []
            for label, (command, options) in runs.items():
                out = Path(folder) / f"{label}.ply".replace(" ", "_")
                words = [capture(name) / "pretrained.ply", "--images", capture(name), "--out", out, "--quiet"]
                run = Process([*command, *words, *(w for k, v in options.items() for w in (f"--{k}", v))])
                report = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
                found[label] = options | run.cost() | {"rows": report["rows"]}
                files.append(clod.load(out).gaussians)
            append(FILE, {"what": "processes", "scene": name, "runs": found, "alike": files[1] == files[2]})


def main() -> None:
    parser = arguments(__doc__)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("quality")
    one.add_argument("scenes", nargs="+")
    one.add_argument("--blocks", type=int, nargs="+", default=[4, 8])
    one.add_argument("--iters", type=int, default=clod.AdaptConfig().steps)
    one.set_defaults(run=quality)
    commands.add_parser("memory").set_defaults(run=memory)
    two = commands.add_parser("processes")
    two.add_argument("scenes", nargs="+")
    two.set_defaults(run=processes)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
