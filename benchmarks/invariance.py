"""A capture in another unit, place and frame, and with one far camera: PSNR and kept shares after adapting.

    python benchmarks/invariance.py plush_half --record

The default settings with ``max_sv`` 7. ``change`` says what was changed, before training; nothing else is.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace

import clod_adapter as clod
from clod_adapter.cameras import in_its_unit
from common import Row, append, arguments, checkpoint, photographs

import torch

FILE, DIALS = "invariance.jsonl", (1.0, 3.0, 7.0)
Pair = tuple[clod.Gaussians, clod.Scene]


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("scenes", nargs="*", default=["plush_half", "bonsai146"])
    args = parser.parse_args()
    for scene in args.scenes:
        for change, make in CHANGES.items():
            row = run(scene, change, *make(checkpoint(scene).gaussians, photographs(scene)))
            if args.record:
                append(FILE, row)
            else:
                print(json.dumps(row), flush=True)


def run(scene: str, change: str, base: clod.Gaussians, views: clod.Scene) -> Row:
    plan = clod.make_plan(base, views, clod.AdaptConfig(max_sv=DIALS[-1]))
    adapted = plan.adapt(views, False)
    rows = clod.evaluate(plan.whole(base, adapted.gaussians), views.test, DIALS)
    return {
        "benchmark": "invariance", "scene": scene, "change": change, "steps": adapted.steps,
        "psnr": [row.psnr for row in rows], "kept": [row.kept_share for row in rows],
    }  # fmt: skip


def scaled(factor: float) -> Callable[[clod.Gaussians, clod.Scene], Pair]:
    def change(base: clod.Gaussians, views: clod.Scene) -> Pair:
        base = base.replace(means=factor * base.means, log_scales=base.log_scales + math.log(factor))
        return base, with_cameras(views, lambda viewmat: torch.cat([viewmat[:, :3], factor * viewmat[:, 3:]], 1))

    return change


def moved(base: clod.Gaussians, views: clod.Scene) -> Pair:
    """By 100 units. Of a checkpoint that is farther from 0, loading moves the origin."""
    by = torch.full((3,), 100.0, dtype=torch.float64)

    def change(viewmat: torch.Tensor) -> torch.Tensor:
        wide = viewmat.double()
        return torch.cat([wide[:, :3], (wide[:, 3] - wide[:, :3] @ by)[:, None]], 1).to(viewmat)

    return base.replace(means=base.means + by.float()), with_cameras(views, change)


def with_cameras(views: clod.Scene, change: Callable[[torch.Tensor], torch.Tensor]) -> clod.Scene:
    def changed(view: clod.View) -> clod.View:
        matrix = view.camera.viewmat.clone()
        matrix[:3] = change(matrix[:3])
        return view.at(replace(view.camera, viewmat=matrix))

    return in_its_unit(clod.Scene(*(tuple(map(changed, part)) for part in (views.train, views.test))))


def one_far_camera(base: clod.Gaussians, views: clod.Scene) -> Pair:
    """30 times as far from the scene's centre as the first one, with the checkpoint's render as its photograph."""
    first, centre = views.train[0].camera, base.means.median(0).values
    matrix = first.viewmat.clone()
    matrix[:3, 3] -= matrix[:3, :3] @ (29 * (first.position - centre))
    camera = replace(first, viewmat=matrix)
    far = clod.View(camera, clod.render(base, camera).pixels)
    return base, replace(views, train=(*views.train, far))


CHANGES: dict[str, Callable[[clod.Gaussians, clod.Scene], Pair]] = {
    "none": lambda base, views: (base, views),
    "1000 times as large": scaled(1000.0),
    "1000 times as small": scaled(1e-3),
    "moved": moved,
    "one far camera": one_far_camera,
}

if __name__ == "__main__":
    main()
