"""The cost of saving the training state, and of resuming from it.

    python benchmarks/interruptions.py                       # plush_half, 300 steps
    python benchmarks/interruptions.py bonsai146 --iters 1500

Adapts as ``clod-adapt`` does, with its saver. ``saving_share`` is the share of the training time that saving takes. The
states are flushed to the disk of ``--folder``. ``load_seconds`` is the time to read the last state.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import clod_adapter as clod  # before torch: it sets how OpenMP's threads wait

# isort: split
import torch
from common import append, arguments, checkpoint, photographs

from clod_adapter.cli.adapt.resume import Saver, identify
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.interrupts import GracefulStop
from clod_adapter.training.state_file import load_state

FILE = "resume.jsonl"
THREADS = 2


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*", default=["plush_half"])
    parser.add_argument("--iters", type=int, default=300)
    parser.add_argument("--folder", help="where to save (default: a temporary folder)")
    args = parser.parse_args()
    torch.set_num_threads(THREADS)
    for scene in args.scenes:
        with tempfile.TemporaryDirectory(dir=args.folder) as folder:
            measure(scene, clod.AdaptConfig(iters=args.iters), Path(folder) / "dial.resume.safetensors")


def measure(scene: str, config: clod.AdaptConfig, path: Path) -> None:
    base, views = checkpoint(scene), photographs(scene)
    began = time.perf_counter()
    names = argparse.Namespace(ply=scene, images=scene)
    saver = Saver(
        path, identify(None, base.gaussians, views, config, names, Console()), None, Console(), GracefulStop()
    )
    digest_seconds = time.perf_counter() - began
    adapted = clod.adapt(base.gaussians, views, config, saver.saving(lambda progress: None))
    saver.keep()
    began = time.perf_counter()
    load_state(path)
    append(FILE, {
        "benchmark": "interruptions", "scene": scene, "threads": THREADS, "gaussians": len(base.gaussians),
        "steps": adapted.steps, "start_seconds": round(adapted.start_seconds, 2),
        "train_seconds": round(adapted.seconds, 2), "saves": saver.saves,
        "saving_seconds": round(saver.seconds, 3), "saving_share": round(saver.seconds / adapted.seconds, 5),
        "state_bytes": path.stat().st_size, "load_seconds": round(time.perf_counter() - began, 3),
        "digest_seconds": round(digest_seconds, 3),
    })  # fmt: skip


if __name__ == "__main__":
    main()
