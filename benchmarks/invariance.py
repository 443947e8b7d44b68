"""A capture in another unit, place and frame, with one far camera, with a far shell, split: PSNR and shares it keeps.

    python benchmarks/invariance.py plush_half --changes none turned --record

The default settings with ``max_sv`` 7. ``change`` says what was changed, before training; nothing else is. ``base`` is
the PSNR before, which a split or a shell changes. One camera more changes the order of the views, as another seed does:
compare the far one with one more in the place of the first.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import clod_adapter as clod
from clod_adapter.cameras import in_its_unit
from clod_adapter.io.checkpoint import blank
from clod_adapter.rasterizers.reference import rotations, sh_basis
from common import Row, append, arguments, checkpoint, photographs

import torch
from torch import Tensor

FILE, DIALS = "invariance.jsonl", (1.0, 3.0, 7.0)
Pair = tuple[clod.Gaussians, clod.Scene]


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("scenes", nargs="*", default=["plush_half", "bonsai146"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--changes", nargs="+", choices=CHANGES, default=list(CHANGES))
    args = parser.parse_args()
    for scene in args.scenes:
        for change in args.changes:
            row = run(scene, change, args.seed, *CHANGES[change](checkpoint(scene).gaussians, photographs(scene)))
            if args.record:
                append(FILE, row)
            else:
                print(json.dumps(row), flush=True)


def run(scene: str, change: str, seed: int, base: clod.Gaussians, views: clod.Scene) -> Row:
    plan = clod.make_plan(base, views, clod.AdaptConfig(max_sv=DIALS[-1], seed=seed))
    adapted = plan.adapt(views, False)
    rows = clod.evaluate(plan.whole(base, adapted.gaussians), views.test, DIALS)
    (before,) = clod.evaluate(base, views.test, [1.0])
    return {
        "benchmark": "invariance", "scene": scene, "change": change, "seed": seed, "steps": adapted.steps,
        "base": before.psnr, "psnr": [row.psnr for row in rows], "kept": [row.kept_share for row in rows],
    }  # fmt: skip


def scaled(factor: float) -> Callable[[clod.Gaussians, clod.Scene], Pair]:
    def change(base: clod.Gaussians, views: clod.Scene) -> Pair:
        base = base.replace(means=factor * base.means, log_scales=base.log_scales + math.log(factor))
        return base, with_cameras(views, lambda viewmat: torch.cat([viewmat[:, :3], factor * viewmat[:, 3:]], 1))

    return change


def moved(base: clod.Gaussians, views: clod.Scene) -> Pair:
    """By 100 units."""
    return base.replace(means=base.means + 100), moved_cameras(views, [100.0] * 3)


def moved_in_a_file(base: clod.Gaussians, views: clod.Scene) -> Pair:
    """By 10,000 units, as coordinates of a file: loading it moves the origin."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "moved.ply"
        clod.save(path, base, blank(len(base), base.sh_degree, (1e4, 1e4, 1e4)))
        loaded = clod.load(path)
    return loaded.gaussians, moved_cameras(views, [1e4 - there for there in loaded.origin])


def moved_cameras(views: clod.Scene, by: Sequence[float]) -> clod.Scene:
    offset = torch.tensor(by, dtype=torch.float64)

    def change(viewmat: Tensor) -> Tensor:
        wide = viewmat.double()
        return torch.cat([wide[:, :3], (wide[:, 3] - wide[:, :3] @ offset)[:, None]], 1).to(viewmat)

    return with_cameras(views, change)


def turned(base: clod.Gaussians, views: clod.Scene) -> Pair:
    """By 107 degrees about an axis of no special direction, with the spherical harmonics."""
    w, x, y, z = by = torch.nn.functional.normalize(torch.tensor([0.6, 0.3, -0.7, 0.2]), dim=0)
    product = torch.stack(
        [by, torch.stack([-x, w, z, -y]), torch.stack([-y, -z, w, x]), torch.stack([-z, y, -x, w])], 1
    )
    (turn,) = rotations(by[None])
    ways = torch.nn.functional.normalize(torch.randn(500, 3, dtype=torch.float64), dim=1)
    before, after = (sh_basis(each)[:, 1 : 1 + base.shN.shape[1]] for each in (ways, ways @ turn.double().T))
    harmonics = torch.linalg.lstsq(after, before).solution.float()
    base = base.replace(
        means=base.means @ turn.T, quats=base.quats @ product.T, shN=torch.einsum("kj,njc->nkc", harmonics, base.shN)
    )
    return base, with_cameras(views, lambda viewmat: torch.cat([viewmat[:, :3] @ turn.T, viewmat[:, 3:]], 1))


def split(base: clod.Gaussians, views: clod.Scene) -> Pair:
    """Each Gaussian in eight, at half a standard deviation along its axes, with about the same integral."""
    corners = 0.5 * torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]).float()
    axes = rotations(base.quats) * base.scales[:, None, :]
    rows = torch.arange(len(base)).repeat_interleave(8)
    return base.select(rows).replace(
        means=(base.means[:, None] + torch.einsum("nij,kj->nki", axes, corners)).reshape(-1, 3),
        log_scales=base.log_scales[rows] + 0.5 * math.log(0.75),
        opacity_logits=torch.special.logit(1 - (1 - base.opacities[rows].clamp(max=0.999)) ** (1 / 6)),
    ), views


def shell(base: clod.Gaussians, views: clod.Scene) -> Pair:
    """A twentieth more Gaussians, around the scene, 100 times as far as half of it; photographs show them behind it."""
    centre, count, random = base.means.median(0).values, len(base) // 20, torch.Generator().manual_seed(0)
    off = 100 * (base.means - centre).norm(dim=1).median()
    sides = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=1)
    far = base.select(torch.arange(count)).replace(
        means=centre + off * sides, log_scales=(4 * off / count**0.5).log().expand(count, 3),
        opacity_logits=torch.full((count,), 2.0), sh0=torch.rand(count, 1, 3, generator=random) - 0.5,
        shN=torch.zeros(count, *base.shN.shape[1:]),
    )  # fmt: skip
    both = base.replace(**{name: torch.cat([own, far.tensors()[name]]) for name, own in base.tensors().items()})

    def change(view: clod.View) -> clod.View:
        more = clod.render(both, view.camera).pixels.short() - clod.render(base, view.camera).pixels.short()
        return clod.View(view.camera, (view.image + more).clamp(0, 255).to(torch.uint8))

    return both, replace(views, train=tuple(map(change, views.train)), test=tuple(map(change, views.test)))


def with_cameras(views: clod.Scene, change: Callable[[Tensor], Tensor]) -> clod.Scene:
    def changed(view: clod.View) -> clod.View:
        matrix = view.camera.viewmat.clone()
        matrix[:3] = change(matrix[:3])
        return view.at(replace(view.camera, viewmat=matrix))

    return in_its_unit(clod.Scene(*(tuple(map(changed, part)) for part in (views.train, views.test))))


def one_camera(times: float) -> Callable[[clod.Gaussians, clod.Scene], Pair]:
    """``times`` as far from the scene's centre as the first one, with the checkpoint's render as its photograph."""

    def change(base: clod.Gaussians, views: clod.Scene) -> Pair:
        first, centre = views.train[0].camera, base.means.median(0).values
        matrix = first.viewmat.clone()
        matrix[:3, 3] -= matrix[:3, :3] @ ((times - 1) * (first.position - centre))
        camera = replace(first, viewmat=matrix)
        return base, replace(views, train=(*views.train, clod.View(camera, clod.render(base, camera).pixels)))

    return change


CHANGES: dict[str, Callable[[clod.Gaussians, clod.Scene], Pair]] = {
    "none": lambda base, views: (base, views),
    "1000 times as large": scaled(1000.0),
    "1000 times as small": scaled(1e-3),
    "moved": moved,
    "moved in a file": moved_in_a_file,
    "turned": turned,
    "one more camera": one_camera(1.0),
    "one far camera": one_camera(30.0),
    "shell": shell,
    "split in eight": split,
}

if __name__ == "__main__":
    main()
