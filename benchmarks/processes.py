"""Adapting in several processes against one: equality, and the quality of a larger batch.

    python benchmarks/processes.py plush_half --views 300

Three adaptations with the same number of views: one view per step; two views per step in one process; two views per
step in two processes (torchrun, gloo). The row has the held-out PSNR of each, the seconds, and the difference between
the last two by attribute (``results/processes.jsonl``).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from argparse import SUPPRESS
from pathlib import Path
from typing import Any

import clod_adapter as clod
from clod_adapter.training.distributed import joined
from common import append, arguments, checkpoint, photographs

import torch

FILE, DIALS = "processes.jsonl", (1.0, 2.0, 5.0)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*", default=["plush_half"])
    parser.add_argument("--views", type=int, default=1500, help="of each of the three runs")
    parser.add_argument("--part", nargs=3, metavar=("SCENE", "CONFIG", "FILE"), help=SUPPRESS)
    args = parser.parse_args()
    if args.part:
        take_part(args.part[0], clod.AdaptConfig(**json.loads(args.part[1])), Path(args.part[2]))
        return
    for scene in args.scenes:
        measure(scene, args.views)


def measure(scene: str, views: int) -> None:
    double, results, quality = {"iters": views // 2, "batch": 2}, {}, {}
    runs: dict[str, tuple[int, dict[str, Any]]] = {
        "batch 1": (1, {"iters": views, "batch": 1}), "batch 2": (1, double), "batch 2, two processes": (2, double)
    }  # fmt: skip
    for label, (processes, config) in runs.items():
        results[label], seconds = run(scene, processes, config)
        rows = [row.as_dict() for row in clod.evaluate(results[label], photographs(scene).test, DIALS)]
        quality[label] = {"steps": config["iters"], "seconds": seconds, "rows": rows}
    one, two = results["batch 2"].tensors(), results["batch 2, two processes"].tensors()
    append(FILE, {
        "benchmark": "processes", "scene": scene, "views": views, "quality": quality,
        "largest_difference": {name: float((one[name] - two[name]).abs().amax()) for name in one if one[name].numel()},
    })  # fmt: skip


def run(scene: str, processes: int, config: dict[str, Any]) -> tuple[clod.Gaussians, float]:
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.pt"
        part = [__file__, "--part", scene, json.dumps(config), str(file)]
        subprocess.run([sys.executable, *(launcher if processes > 1 else []), *part], check=True)
        return torch.load(file, weights_only=False)


def take_part(scene: str, config: clod.AdaptConfig, file: Path) -> None:
    """The work of each process; the first one writes the result."""
    base, views = checkpoint(scene).gaussians, photographs(scene)
    if "RANK" not in os.environ:
        adapted = clod.adapt(base, views, config)
    else:
        from torch.distributed.rendezvous import rendezvous

        with joined(*next(iter(rendezvous("env://")))) as group:
            adapted = clod.adapt(base, views, config, group=group)
        if group.rank > 0:
            return
    torch.save((adapted.gaussians, adapted.seconds), file)


if __name__ == "__main__":
    main()
