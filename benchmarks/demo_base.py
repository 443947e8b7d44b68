"""The capture and the base of ``clod-adapt demo``: ray-traces the gallery, and trains a checkpoint on it to its end.

    python benchmarks/demo_base.py --record    # clod_adapter/demo/capture.zip and base.spz; a quarter of an hour

Adds a row to ``results/demo_base.jsonl``: PSNR of the held-out views before and after packing, bytes and times.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

import clod_adapter as clod
from clod_adapter.cli.shared.console import Console
from clod_adapter.config import SH_COUNTS
from clod_adapter.gaussians import SH_C0
from clod_adapter.io.file_formats import write
from common import ROOT, append, arguments
from gallery import make_gallery, write_capture
from tuning import RATES, Tuning, tune

import numpy as np
import torch
from scipy.spatial import cKDTree

DEMO = ROOT / "clod_adapter" / "demo"
QUALITY = 80  # of the photographs as WebP
POINTS, DEGREE, STEPS = 80_000, 1, 10_000
FASTER, FINAL = 2.5, 0.01  # than 3DGS's learning rates at first; what is left of them at the end, a share


def main() -> None:
    parser = arguments(__doc__, record="demo_base.jsonl")
    args, began = parser.parse_args(), time.perf_counter()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "capture"
        gallery = make_gallery()
        write_capture(folder, gallery, QUALITY)
        traced, scene = time.perf_counter() - began, clod.load_scene(folder)
        config = Tuning(iters=STEPS, rates={name: FASTER * rate for name, rate in RATES.items()}, final=FINAL)
        with Console().meter("base") as meter:
            trained = tune(from_points(*gallery.sample_points(POINTS)), scene.train, config, meter.update)
        write(DEMO / "base.spz", trained.gaussians)
        shutil.make_archive(str(DEMO / "capture"), "zip", folder)
    files = {name: (DEMO / name).stat().st_size for name in ("capture.zip", "base.spz")}
    found = {"trained": trained.gaussians, "packed": clod.load(DEMO / "base.spz").gaussians}
    row = {
        "benchmark": "demo_base", "gaussians": POINTS, "sh_degree": DEGREE, "steps": STEPS, "bytes": files,
        "seconds": {"tracing": traced, "training": trained.seconds},
        "psnr": {name: clod.evaluate(gaussians, scene.test, [0])[0].psnr for name, gaussians in found.items()},
    }  # fmt: skip
    if args.record:
        append("demo_base.jsonl", row)
    else:
        print(row)


def from_points(points: np.ndarray, colors: np.ndarray) -> clod.Gaussians:
    """3DGS's initialization: isotropic Gaussians scaled by the distance to neighbours, opacity 0.1."""
    n, means = len(points), torch.from_numpy(points)
    distances = cKDTree(points).query(points, 4)[0][:, 1:]
    spacing = torch.from_numpy(np.sqrt(np.square(distances).mean(1))).float().clamp(min=1e-4)
    return clod.Gaussians(
        means=means, quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), log_scales=spacing.log()[:, None].repeat(1, 3),
        opacity_logits=torch.full((n,), 0.1).logit(), sh0=((torch.from_numpy(colors) / 255 - 0.5) / SH_C0)[:, None],
        shN=torch.zeros(n, SH_COUNTS[DEGREE] - 1, 3),
    )  # fmt: skip


if __name__ == "__main__":
    main()
