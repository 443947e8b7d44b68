"""Each file format: bytes per Gaussian, the error of sigma_d, and PSNR against the PLY.

    python benchmarks/formats.py plush_half
    python benchmarks/formats.py --table                  # the rows as a Markdown table

A checkpoint gets a sigma_d without training (``importance.initialize``), is written in each format
that stores one and read again. PSNR is between the renders at s and those of the PLY, as means over
the held-out views, in floating point; null where they are equal. ``.splat`` stores no sigma_d: a
model baked at s is written and compared. Each format adds one row to ``results/formats.jsonl``.
"""

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import clod_adapter as clod
from clod_adapter.initialization.importance import initialize, usable_views
from clod_adapter.io.file_formats import FORMATS, WRITABLE, write
from common import Row, append, arguments, checkpoint, photographs, stored, table

import torch

FILE = "formats.jsonl"
DIALS = (1.0, 5.0)


def main() -> None:
    parser = arguments(__doc__, table=print_table)
    parser.add_argument("scenes", nargs="*")
    for scene in parser.parse_args().scenes:
        run(scene, clod.AdaptConfig(max_sv=max(DIALS)))


def run(scene: str, config: clod.AdaptConfig) -> None:
    base, views = checkpoint(scene).gaussians, photographs(scene)
    model = initialize(base, usable_views(base, views.train), config, lambda *_: None)
    cameras = [view.camera for view in views.test]
    trained_on = [view.camera for view in views.train]
    baked = {s: clod.bake(model, s, cameras=trained_on) for s in DIALS}
    for suffix in WRITABLE:
        dial = FORMATS[suffix].carries_sigma
        row = {"benchmark": "formats", "scene": scene, "suffix": suffix, "dial": dial}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"model{suffix}"
            for s in DIALS:
                source = model if dial else baked[s]
                row |= round_trip(path, source) if s == 1 or not dial else {}
                row[f"s{s:g}"] = pictures(source, clod.load(path).gaussians, cameras, s)
        append(FILE, row)


def round_trip(path: Path, gaussians: clod.Gaussians) -> Row:
    """The size, and the largest relative error of sigma_d, of those of at least 1e-4."""
    notes = write(path, gaussians)
    again = clod.load(path).gaussians
    error = None
    if gaussians.sigma_d is not None and again.sigma_d is not None:
        # SPZ moves the farthest nearer
        there = (again.means - gaussians.means).abs().amax(1) <= 1e-3
        old, new = gaussians.sigma_d.double()[there], again.sigma_d.double()[there]
        error = float(((new - old) / old)[old >= 1e-4].abs().max())
    return {
        "count": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "notes": notes,
        "sigma_error": error,
        "bytes_per_gaussian": round(path.stat().st_size / len(gaussians), 2),
    }


@torch.no_grad()
def pictures(
    gaussians: clod.Gaussians, again: clod.Gaussians, cameras: Sequence[clod.Camera], s: float
) -> Row:
    """PSNR between the two, the mean over the views."""
    decibels = []
    for camera in cameras:
        before, after = (
            clod.render(model, camera, virtual_scale=s).image.clamp(0, 1)
            for model in (gaussians, again)
        )
        error = float((before - after).double().square().mean())
        decibels += [-10 * math.log10(error)] if error > 0 else []
    return {"psnr": round(fmean(decibels), 2) if len(decibels) == len(cameras) else None}


def print_table() -> None:
    keys = ("scene", "suffix", "bytes_per_gaussian", "sigma_error")
    lines = [[*map(row.get, keys), row["s1"]["psnr"], row["s5"]["psnr"]] for row in stored(FILE)]
    print(table([*keys, "PSNR at s = 1", "at s = 5"], lines))


if __name__ == "__main__":
    main()
