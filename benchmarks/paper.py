"""The paper's ablations, and its comparison of continuous with discrete levels of detail.

    python benchmarks/paper.py plush_half demo    # captures; the folder of clod-adapt demo

Ablations: ``AdaptConfig.paper(max_sv=5)`` without the weight ``w_s``, without ``L_reg``, without
both, and from another start. Levels: four strips of a picture from coarse to fine. Continuous is
one file of this package at the dial values DIALS. Discrete is two models, two strips each: the base
merged to the count of DIALS[0] and tuned for it, and the base; on average they draw as many
Gaussians. A seam is the RMS difference, in 8-bit levels, between the renders of the two models that
meet at a boundary of strips, in the columns next to it. Each run adds rows to
``results/paper.jsonl``; the demo is also drawn, to docs/images/strips.webp.
"""

from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import clod_adapter as clod
from clod_adapter.losses import decibels, mean_squared_error
from clod_adapter.training.paper import PaperDial
from common import ROOT, Table, append, arguments, last, opened, psnr_kept, quality
from tuning import merge

import numpy as np
import torch
from PIL import Image

FILE, PICTURE = "paper.jsonl", ROOT / "docs" / "images" / "strips.webp"
MAX_SV, SHOWN = 5.0, (1.0, 3.0, 5.0)
DIALS = (5.0, 2.0, 1.0, 0.0)  # of the strips, from left to right
EDGE = 8  # columns on each side of a boundary
SLOPE = PaperDial.weight_slope
ABLATIONS = {  # slope of w_s, weight of L_reg, and sigma_d at the start
    "as published": (SLOPE, 1.0, 1.0),
    "without `w_s`": (0.0, 1.0, 1.0),
    "without `L_reg`": (SLOPE, 0.0, 1.0),
    "without both": (0.0, 0.0, 1.0),
    "from `sigma_d` = max_sv": (SLOPE, 1.0, MAX_SV),
}


def main():
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="+")
    for scene in parser.parse_args().scenes:
        base, views = opened(scene)
        name = Path(scene).name
        for row in ablations(base, views):
            append(FILE, {"kind": "ablation", "scene": name, **row})
        pictures = []
        for row, picture in strips(base, views):
            append(FILE, {"kind": "strips", "scene": name, **row})
            pictures.append(picture)
        if name == "demo":
            Image.fromarray(np.concatenate(pictures)).save(PICTURE, quality=90)


def ablations(base, views):
    for label, (slope, weight, start) in ABLATIONS.items():
        config = clod.AdaptConfig.paper(max_sv=MAX_SV, reg_weight=weight)
        begun = PaperDial.begin(base.gaussians, views.train, config)
        begun = begun.replace(sigma_d=start * begun.sigma_d)
        with patch.object(PaperDial, "weight_slope", slope):
            gaussians = clod.adapt(begun, views, config).gaussians
        yield {"label": label, "rows": quality(gaussians, views.test, SHOWN)}


def strips(base, views):
    """A row and a picture of each way."""
    adapted = clod.adapt(base.gaussians, views, clod.AdaptConfig(max_sv=MAX_SV)).gaussians
    (coarsest,) = quality(adapted, views.test, DIALS[0])
    merged, _ = merge(base, round(coarsest["kept"]), "--decimate")
    tuned = clod.tune(merged, views.train)
    for label, models in {
        "discrete": [(tuned, 1.0)] * 2 + [(base.gaussians, 1.0)] * 2,
        "continuous": [(adapted, s) for s in DIALS],
    }.items():
        row, picture = compare(models, views.test)
        yield {"label": label, **row}, picture


@torch.no_grad()
def compare(models, views):
    """PSNR of each strip, seams and share of the base, means over the views; and a picture."""
    errors, seams, kept = [], [], []
    for view in views:
        drawn = [clod.render(model, view.camera, virtual_scale=s) for model, s in models]
        images = [each.image.clamp(0, 1) for each in drawn]
        kept.append(np.mean([int(each.kept.sum()) for each in drawn]))
        edges = np.linspace(0, view.camera.width, len(models) + 1).round().astype(int)
        strips = [slice(*ends) for ends in pairwise(edges)]
        parts = [image[:, strip] for image, strip in zip(images, strips, strict=True)]
        truths = [view.image[:, strip] for strip in strips]
        errors.append(list(map(mean_squared_error, parts, truths)))
        seams.append([])
        for (left, right), edge in zip(pairwise(images), edges[1:-1], strict=True):
            near = slice(edge - EDGE, edge + EDGE)
            difference = (left[:, near] - right[:, near]).square().mean().sqrt()
            seams[-1].append(255 * float(difference))
    row = {
        "strips": [decibels(error) for error in np.mean(errors, 0)],
        "seams": np.mean(seams, 0).tolist(),
        "kept": float(np.mean(kept)),
    }
    return row, (255 * torch.cat(parts, 1)).round().byte().numpy()


def page_table():
    """The ablations at SHOWN."""
    found = last(FILE, "scene", "label", kind="ablation")
    lines = []
    for key, row in found.items():
        lines.append([", ".join(key), *map(psnr_kept, row["rows"])])
    return Table(["", *(f"s = {s:g}" for s in SHOWN)], lines, found.values())


def strips_table():
    """PSNR of the strips, and the seams between them."""
    found = last(FILE, "scene", "label", kind="strips")
    lines = []
    for key, row in found.items():
        psnrs = " / ".join(f"{each:.1f}" for each in row["strips"])
        seams = " / ".join(f"{each:.1f}" for each in row["seams"])
        lines.append([", ".join(key), psnrs, seams, f"{row['kept']:,.0f}"])
    heads = ["levels of detail", "PSNR of the strips", "seams, levels", "Gaussians, mean"]
    return Table(heads, lines, found.values())


if __name__ == "__main__":
    main()
