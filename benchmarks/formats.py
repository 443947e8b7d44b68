"""Each file format: bytes per Gaussian, seconds, the error of sigma_d, and PSNR against the PLY.

    python benchmarks/formats.py plush_half
    python benchmarks/formats.py --table                  # the rows as a Markdown table

A checkpoint gets a sigma_d without training (``importance.initialize``), is written in each format that stores one and
read again. PSNR is between the renders at s and those of the PLY, as means over the held-out views, in floating point;
null where they are equal. ``.splat`` stores no sigma_d: a model baked at s is written and compared. Each format adds
one row to ``results/formats.jsonl``.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean, median
from typing import Any

import clod_adapter as clod
from clod_adapter.initialization.importance import initialize, usable_views
from clod_adapter.io.file_formats import FORMATS, WRITABLE, read_model, write
from common import append, arguments, checkpoint, photographs, print_rows

import torch

FILE = "formats.jsonl"
COLUMNS = (
    "scene",
    "suffix",
    "bytes_per_gaussian",
    "write_seconds",
    "read_seconds",
    "sigma_error",
    "decay_error",
    "s1.psnr",
    "s5.psnr",
)
DIALS = (1.0, 5.0)
REPEATS = 5


def main() -> None:
    parser = arguments(__doc__, table=lambda: print_rows(FILE, *COLUMNS))
    parser.add_argument("scenes", nargs="*")
    for scene in parser.parse_args().scenes:
        run(scene, clod.AdaptConfig(max_sv=max(DIALS)))


def run(scene: str, config: clod.AdaptConfig) -> None:
    base, views = checkpoint(scene).gaussians, photographs(scene)
    model = initialize(base, usable_views(base, views.train), config, lambda *_: None)
    cameras = [view.camera for view in views.test]
    baked = {s: clod.bake(model, s, cameras=[view.camera for view in views.train]) for s in DIALS}
    for suffix in WRITABLE:
        sources = {s: model if FORMATS[suffix].carries_sigma else baked[s] for s in DIALS}
        row: dict[str, Any] = {}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"model{suffix}"
            for s in reversed(DIALS):
                row |= round_trip(path, sources[s], row)
                row[f"s{s:g}"] = pictures(sources[s], read(path), cameras, s)
        append(FILE, {
            "benchmark": "formats", "scene": scene, "config": asdict(config), "suffix": suffix, "views": len(cameras),
            "dial": FORMATS[suffix].carries_sigma, "threads": torch.get_num_threads(), **row,
        })  # fmt: skip


def read(path: Path) -> clod.Gaussians:
    return clod.load(path).gaussians if path.suffix == ".ply" else read_model(path).gaussians


def round_trip(path: Path, gaussians: clod.Gaussians, before: dict[str, Any]) -> dict[str, Any]:
    """What writing and reading take; nothing more where the same Gaussians have been through it."""
    if before and before["count"] == len(gaussians):
        return {}
    writing, reading = [], []
    for _ in range(REPEATS):
        began = time.perf_counter()
        notes = write(path, gaussians)
        written = time.perf_counter()
        again = read(path)
        writing.append(written - began)
        reading.append(time.perf_counter() - written)
    return {
        "count": len(gaussians), "sh_degree": gaussians.sh_degree, "notes": notes,
        "bytes_per_gaussian": round(path.stat().st_size / len(gaussians), 2),
        "write_seconds": round(median(writing), 4), "read_seconds": round(median(reading), 4),
        **sigma_errors(gaussians, again),
    }  # fmt: skip


def sigma_errors(gaussians: clod.Gaussians, again: clod.Gaussians) -> dict[str, float | None]:
    """The largest relative error of sigma_d, of those at least as large as training lets them be (1e-4), and of all.

    The latter is of ``sqrt(sigma_d^2 + eps / 2)``, which is all that the equation takes of it. Without the Gaussians
    that a format moves nearer, whose sigma_d goes with their distance. None without a sigma_d.
    """
    if gaussians.sigma_d is None or again.sigma_d is None or gaussians.attenuation is None:
        return {"sigma_error": None, "decay_error": None}
    there = (again.means - gaussians.means).abs().amax(1) <= 1e-3
    old, new = gaussians.sigma_d.double()[there], again.sigma_d.double()[there]
    decays = [(sigma.clamp(min=0).square() + gaussians.attenuation.eps / 2).sqrt() for sigma in (old, new)]
    return {
        "sigma_error": float(((new - old) / old)[old >= 1e-4].abs().max()),
        "decay_error": float((decays[1] / decays[0] - 1).abs().max()),
    }


@torch.no_grad()
def pictures(
    gaussians: clod.Gaussians, again: clod.Gaussians, cameras: Sequence[clod.Camera], s: float
) -> dict[str, Any]:
    """PSNR between the two and the share of the Gaussians that the dial keeps in each, means over the views."""
    errors, kept = [], []
    for camera in cameras:
        ours, theirs = (clod.render(each, camera, virtual_scale=s) for each in (gaussians, again))
        errors.append(float((ours.image.clamp(0, 1) - theirs.image.clamp(0, 1)).double().square().mean()))
        kept.append((float(ours.kept.float().mean()), float(theirs.kept.float().mean())))
    decibels = [-10 * math.log10(error) for error in errors if error > 0]
    return {
        "psnr": round(fmean(decibels), 2) if len(decibels) == len(errors) else None,
        "kept": [round(fmean(share), 5) for share in zip(*kept, strict=True)],
    }  # fmt: skip


if __name__ == "__main__":
    main()
