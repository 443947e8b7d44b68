"""Adapting in several processes against one: equality, speed, and the quality of a larger batch.

    python benchmarks/processes.py plush_half --views 300 --repeats 1

Three adaptations with the same number of views: one view per step; two views per step in one process with two threads;
two views per step in two processes with one thread each (torchrun, gloo). ``quality`` has the held-out PSNR of each,
``largest_difference`` the difference between the last two by attribute, ``speed`` median seconds of both over
``--speed-steps`` steps: initialization, training, and of training the waiting and the exchange of gradients.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from argparse import SUPPRESS, Namespace
from pathlib import Path
from statistics import median
from typing import Any

import clod_adapter as clod
from clod_adapter.training.distributed import joined
from common import append, arguments, checkpoint, photographs

import torch

FILE = "processes.jsonl"
CORES = 2
DIALS = (1.0, 2.0, 5.0)
SPENT = ("start_seconds", "seconds", "waiting", "exchanging")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*", default=["plush_half"])
    parser.add_argument("--views", type=int, default=1500, help="of each of the three runs")
    parser.add_argument("--speed-steps", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--part", nargs=3, metavar=("SCENE", "CONFIG", "FILE"), help=SUPPRESS)
    args = parser.parse_args()
    if args.part:
        take_part(args.part[0], clod.AdaptConfig(**json.loads(args.part[1])), Path(args.part[2]))
        return
    torch.set_num_threads(CORES)
    for scene in args.scenes:
        measure(scene, args)


def measure(scene: str, args: Namespace) -> None:
    double = {"iters": args.views // 2, "batch": 2}
    runs = {
        "batch 1": (1, {"iters": args.views, "batch": 1}),
        "batch 2": (1, double),
        "batch 2, two processes": (2, double),
    }
    results, quality = {}, {}
    test = photographs(scene).test
    for label, (processes, config) in runs.items():
        results[label], spent = run(scene, processes, config)
        rows = [
            {"s": r.virtual_scale, "psnr": round(r.psnr, 4), "kept_share": round(r.kept_share, 4)}
            for r in clod.evaluate(results[label], test, DIALS)
        ]
        quality[label] = {"steps": config["iters"], **spent, "rows": rows}
    one, two = results["batch 2"].tensors(), results["batch 2, two processes"].tensors()
    append(FILE, {
        "benchmark": "processes", "scene": scene, "views": args.views, "seed": 0,
        "gaussians": len(one["means"]), "quality": quality,
        "largest_difference": {name: float((one[name] - two[name]).abs().amax()) for name in one if one[name].numel()},
        "speed": speed(scene, {**double, "iters": args.speed_steps}, args.repeats),
    })  # fmt: skip


def speed(scene: str, config: dict[str, Any], repeats: int) -> dict[str, Any]:
    """Medians over the repeats, in which one process and two take turns."""
    found: dict[int, list[dict[str, float]]] = {1: [], 2: []}
    for _ in range(repeats):
        for processes, spent in found.items():
            spent.append(run(scene, processes, config)[1])
    return {
        f"{processes} of {CORES // processes} threads": {
            "steps": config["iters"], **{name: round(median(s[name] for s in spent), 3) for name in SPENT}
        } for processes, spent in found.items()
    }  # fmt: skip


def run(scene: str, processes: int, config: dict[str, Any]) -> tuple[clod.Gaussians, dict[str, float]]:
    """The result of an adaptation in processes that share the cores, and its seconds."""
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    environment = {**os.environ, "OMP_NUM_THREADS": str(CORES // processes)}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.pt"
        part = [__file__, "--part", scene, json.dumps(config), str(file)]
        subprocess.run([sys.executable, *(launcher if processes > 1 else []), *part], env=environment, check=True)
        return torch.load(file, weights_only=False)


def take_part(scene: str, config: clod.AdaptConfig, file: Path) -> None:
    """The work of each process; the first one writes the result."""
    base, views = checkpoint(scene).gaussians, photographs(scene)
    if "RANK" in os.environ:
        from torch.distributed.rendezvous import rendezvous

        with joined(*next(iter(rendezvous("env://")))) as group:
            group.agree(0.0, True)  # both have read and compiled before a clock runs
            adapted = clod.adapt(base, views, config, group=group)
        if group.rank > 0:
            return
    else:
        adapted = clod.adapt(base, views, config)
    torch.save((adapted.gaussians, {name: getattr(adapted, name) for name in SPENT}), file)


if __name__ == "__main__":
    main()
