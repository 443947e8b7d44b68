"""Each file format: bytes per Gaussian, the error of sigma_d, and PSNR against the PLY.

    python benchmarks/file_formats.py plush_half

A checkpoint gets a sigma_d without training (``importance.initialize``), is written in each format
that stores one and read again. PSNR is between the renders at s and those of the PLY, as means over
the held-out views, in floating point; null where they are equal. Each format adds one row to
``results/formats.jsonl``.
"""

import math
import tempfile
from pathlib import Path
from statistics import fmean

import clod_adapter as clod
from clod_adapter.initialization.importance import initialize, usable_views
from clod_adapter.io.file_formats import WRITABLE, write
from clod_adapter.losses import decibels
from common import Table, append, arguments, checkpoint, last, photographs

import torch

FILE = "formats.jsonl"
DIALS = (1.0, 5.0)
HEADS = [
    "format",
    "sigma_d, growth_d",
    "settings, quality table, origin",
    "bytes per Gaussian (SH 3)",
    "error of sigma_d",
    "image against the PLY's, s = 1 / s = 5",
    "read by",
]
SHOWN = {  # in the table: the dial, settings, PSNR of the pictures, readers
    ".ply": (
        "last columns, float32",
        "header comments; non-default settings also as columns",
        "",
        (
            "Spark, PlayCanvas, mkkellogg, gsplat, brush; splat-transform keeps all columns "
            "and drops the comments; gsply drops both; SIBR needs a plain file"
        ),
    ),
    ".spz": (
        "own record, float16",
        "in the same record",
        "{near} / {far} dB",
        (
            "every reader of SPZ version 3 (splat-transform, gsply, Niantic's library, "
            "Spark 2.2), without the dial"
        ),
    ),
    ".pt": (
        'tensors `splats["sigma_d"]`, `splats["growth_d"]`, float32',
        "string `clod_adapter`",
        "",
        "gsplat's trainer and viewer",
    ),
}


def main():
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*")
    for scene in parser.parse_args().scenes:
        run(scene, clod.AdaptConfig(max_sv=max(DIALS)))


def run(scene, config):
    base, views = checkpoint(scene).gaussians, photographs(scene)
    model = initialize(base, usable_views(base, views.train), config, lambda *_: None)
    cameras = [view.camera for view in views.test]
    for suffix in WRITABLE:
        row = {"scene": scene, "suffix": suffix}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"model{suffix}"
            row |= round_trip(path, model)
            again = clod.load(path).gaussians
            for s in DIALS:
                row[f"s{s:g}"] = pictures(model, again, cameras, s)
        append(FILE, row)


def round_trip(path, gaussians):
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
def pictures(gaussians, again, cameras, s):
    """PSNR between the two, the mean over the views."""
    found = []
    for camera in cameras:
        before, after = (
            clod.render(model, camera, virtual_scale=s).image.clamp(0, 1)
            for model in (gaussians, again)
        )
        found.append(decibels(float((before - after).double().square().mean())))
    mean = fmean(found)
    return {"psnr": round(mean, 2) if mean < math.inf else None}


def page_table():
    """Bytes, errors and PSNR over the captures."""
    found, lines = last(FILE, "suffix", "scene"), []
    for suffix, (dial, settings, pictures, readers) in SHOWN.items():
        rows = [row for (each, _), row in found.items() if each == suffix]
        near = [row["s1"]["psnr"] for row in rows]
        far = [row["s5"]["psnr"] for row in rows]
        image = "identical"
        if any(near + far):
            image = pictures.format(near=span(near), far=span(far))
        error = max(row["sigma_error"] or 0 for row in rows)
        size = span([row["bytes_per_gaussian"] for row in rows])
        off = f"{error:.0e}".replace("e-0", "e-") if error else "0"
        lines.append([f"`{suffix}`", dial, settings, size, off, image, readers])
    return Table(HEADS, lines, found.values())


def span(values):
    return " to ".join(dict.fromkeys((f"{min(values):.0f}", f"{max(values):.0f}")))


if __name__ == "__main__":
    main()
