"""PSNR of baked plain files against the dial, at equal counts.

    clod-adapt ci_banana/pretrained.ply --images ci_banana --max-sv 5 --iters 400 -o clod.ply
    python benchmarks/bake.py clod.ply ci_banana           # --table: the rows as a Markdown table

The count at a dial value is the dial's mean over the held-out views. Files of the nearest count are baked for:

- ``d' = 1``: one distance for all Gaussians, with the opacities of the dial value;
- ``images``: all training cameras, as ``clod-adapt export --images`` does;
- ``stored``: the viewpoints that adapting stores in the file;
- ``placed``: placed cameras.

``at s`` is baked for all training cameras at the dial value itself. Each run adds a row to ``results/bake.jsonl``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import clod_adapter as clod
from clod_adapter.calibration import Viewpoint
from clod_adapter.cameras import spread
from clod_adapter.cli.export.baking import PLACED
from clod_adapter.cli.shared.budgets import VIEWPOINTS
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.equation.distances import viewpoint_of
from clod_adapter.equation.extinction import extinction_scale
from common import append, arguments, photographs, print_rows

import torch

FILE = "bake.jsonl"
COLUMNS = ("scene", "label", "virtual_scale", "count", "psnr")
DIALS = (1.0, 2.0, 3.0, 5.0, 10.0, 20.0)


def main() -> None:
    parser = arguments(__doc__, table=lambda: print_rows(FILE, *COLUMNS))
    parser.add_argument("model", help="an adapted PLY")
    parser.add_argument("scene", help="its capture")
    parser.add_argument("--label", default="", help="how the model was adapted")
    args = parser.parse_args()
    adapted, views = clod.load(args.model).gaussians, photographs(args.scene)
    config = adapted.attenuation
    if config is None:
        raise SystemExit(f"{args.model} has no sigma_d")
    training = [view.camera for view in views.train]
    cameras: dict[str, Sequence[clod.Camera | Viewpoint]] = {
        "images": training,
        "stored": [viewpoint_of(camera, adapted.means, config) for camera in spread(training, VIEWPOINTS)],
        "placed": clod.place_cameras(adapted, views=PLACED),
    }

    rows = []
    for s in [s for s in DIALS if s <= config.max_sv]:
        dial = clod.evaluate(adapted, views.test, [s])[0]
        count = round(dial.kept)
        counts, found = {"dial": dial.kept}, {"dial": dial.psnr}
        files = {"d' = 1": at_one_distance(adapted, count)}
        for name, places in cameras.items():
            least = len(clod.bake(adapted, config.max_sv, cameras=places))
            at = clod.dial_for(adapted, keep=max(count, least), cameras=places, baked=True).virtual_scale
            files[name] = clod.bake(adapted, at, cameras=places)
        files["at s"] = clod.bake(adapted, s, cameras=training)
        for name, gaussians in files.items():
            counts[name], found[name] = len(gaussians), clod.evaluate(gaussians, views.test, [1.0])[0].psnr
        rows.append({"virtual_scale": s, "count": counts, "psnr": found})
    append(FILE, {
        "benchmark": "bake", "model": Path(args.model).name, "label": args.label, "scene": args.scene,
        "gaussians": len(adapted), "views": len(views.test), "training_views": len(training),
        "stored": len(cameras["stored"]), "placed": len(cameras["placed"]), "max_sv": config.max_sv, "rows": rows,
    })  # fmt: skip


def at_one_distance(gaussians: clod.Gaussians, count: int) -> clod.Gaussians:
    """The file of ``count`` rows, fewer where s = 1 keeps fewer, in which all Gaussians are at d' = 1."""
    assert gaussians.sigma_d is not None and gaussians.attenuation is not None
    logits, sigma, config = gaussians.opacity_logits, gaussians.sigma_d, gaussians.attenuation
    ones = torch.ones_like(logits)
    scales = extinction_scale(logits, sigma, ones, config).sort(descending=True).values
    at = attenuate(logits, sigma, ones, max(float(scales[count]), 1.0), config)
    opacities = at.drawn.clamp(1e-9, 1 - 1e-7)
    return clod.detach(gaussians.replace(opacity_logits=opacities.logit())).select(at.keep)


if __name__ == "__main__":
    main()
