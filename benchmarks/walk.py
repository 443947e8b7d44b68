"""Near to far: from a doorstep in a made-up town to a hundred times as far and back, by the dial and by levels.

    python benchmarks/walk.py --record     # adds a row to results/walk.jsonl; docs/images/walk.png, tables of the page
    python benchmarks/walk.py --table      # the tables of the last row

The town is ``city.py``'s. Its checkpoint is the perturbed town, trained on photographs from the streets, from the air
and from as far as the walk; the adapted file is that checkpoint adapted to the same photographs. Both are kept in
``benchmarks/cache`` by their settings. Every frame is compared with the supersampled, unperturbed town. In each frame,
in turn:

- ``base``: the checkpoint;
- ``dial, s = 1``: the adapted file; distance alone decides;
- ``cost, s = 1``: the same, adapted with the target ``cost`` in place of ``count``;
- ``dial, held``: the adapted file at the smallest dial value with at most ``--budget`` Gaussians in view;
- ``levels``: the checkpoint, then the adapted file baked at s = 1, 2, 4 and 8, switched block by block (``choose``);
- ``merged``: as many Gaussians as these, merged from the checkpoint by ``splat-transform --decimate-adaptive``,
  switched at the same places.

The change between successive frames is taken from one camera (``evaluation/popping.py``), so it is that of the level of
detail alone. Time at equal quality: in some frames the fastest of all dial values, or of all levels drawn everywhere,
that is at most so many dB below the base. In the same frames, both targets at each dial value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache, partial
from statistics import median
from typing import Any

import clod_adapter as clod
import walk_page as page
from clod_adapter.cli.shared.console import Console
from clod_adapter.equation.attenuation import dial
from clod_adapter.equation.distances import in_frustum
from clod_adapter.evaluation import popping
from clod_adapter.metrics import psnr
from clod_adapter.render import splat
from common import Row, append, arguments, fill_in, stored, timed
from tuning import merge
from walk_town import Levels, Town, adapted, checkpoint, choose, distances, held

import torch
from torch import Tensor

LEVELS = (1.0, 2.0, 4.0, 8.0)
TURNED = tuple(2 ** (k / 2) for k in range(7))  # dial values of equal quality: 1 to 8
SOME = 9  # frames of equal quality
Shown = tuple[clod.Gaussians, float]
Methods = Mapping[str, Callable[[int], Shown]]  # of each frame: the Gaussians and the dial value


def main() -> None:
    parser = arguments(__doc__, table=lambda: print(page.summary(stored(page.FILE)[-1])), record=page.FILE)
    parser.add_argument("--count", type=int, default=Town.count, help="Gaussians of the town")
    parser.add_argument("--frames", type=int, default=121, help="from near to far")
    parser.add_argument("--repeats", type=int, default=3, help="timed renderings of a frame, each way")
    parser.add_argument("--budget", type=float, default=0.2, help="Gaussians in view, a share of all (dial, held)")
    args = parser.parse_args()
    town = Town(count=args.count)
    row = measure(town, args.frames, args.repeats, args.budget)
    if args.record:
        append(page.FILE, row)
        page.draw(row, town)
        fill_in(page.PAGE, "walk", page.summary(row))
    else:
        print(page.summary(row))


def measure(town: Town, frames: int, repeats: int, budget: float) -> Row:
    (model, about), (costed, about_cost) = adapted(town), adapted(town, "cost")
    base, path = checkpoint(town), town.path(frames)
    baked = [clod.bake(model, s, cameras=town.cameras()) for s in LEVELS]
    merged = [merge(base, len(each))[0].replace(screen_filter=model.screen_filter) for each in baked]
    full, chosen = base.gaussians, choose(model, town, path, LEVELS)
    dials = held(model, path, budget * len(full))
    levels, others = Levels([full, *baked], town), Levels([full, *merged], town)
    methods: Methods = {
        "base": lambda k: (full, 1.0),
        "dial, s = 1": lambda k: (model, 1.0),
        "cost, s = 1": lambda k: (costed, 1.0),
        "dial, held": lambda k: (model, dials[k]),
        "levels": lambda k: (levels.drawn(chosen[k]), 1.0),
        "merged": lambda k: (others.drawn(chosen[k]), 1.0),
    }
    some = [round(k * (frames - 1) / (SOME - 1)) for k in range(SOME)]
    settings = {
        "dial": [(model, s) for s in TURNED],
        "cost": [(costed, s) for s in TURNED],
        "levels": [(each, 1.0) for each in baked],
        "merged": [(each, 1.0) for each in merged],
    }
    return {
        "benchmark": "walk", "town": asdict(town), "adapted": about, "adapted_cost": about_cost, "repeats": repeats,
        "counts": {"base": len(full), "levels": [len(each) for each in baked]}, "dials": LEVELS, "turned": TURNED,
        "distances": distances(frames), "held": dials, "chosen": chosen, "budget": round(budget * len(full)),
        "frames": walk(methods, town, path, repeats), "changes": changes(methods, path),
        "equal": [equal(full, settings, town, path[k], 2 * repeats) for k in some],
        "equal_distances": [distances(frames)[k] for k in some],
    }  # fmt: skip


@torch.no_grad()
def walk(methods: Methods, town: Town, path: Sequence[clod.Camera], repeats: int) -> dict[str, dict[str, list[float]]]:
    """Of each method in each frame: milliseconds (median of both ways), Gaussians in view, PSNR against the truth."""
    times: list[dict[str, list[float]]] = [{name: [] for name in methods} for _ in path]
    found: dict[str, dict[str, list[float]]] = {name: {"ms": [], "in_view": [], "psnr": []} for name in methods}
    last = len(path) - 1
    with Console().meter("there and back") as meter:
        for visit, k in enumerate([*range(last + 1), *range(last, -1, -1)]):
            shown = {name: of(k) for name, of in methods.items()}
            if visit <= last:
                view = town.photograph(path[k])
                for name, (gaussians, s) in shown.items():
                    for key, value in compared(gaussians, view, s).items():
                        found[name][key].append(value)
            jobs = {name: partial(clod.render, gaussians, path[k], s) for name, (gaussians, s) in shown.items()}
            for name, taken in timed(jobs, repeats).items():
                times[k][name] += taken
            meter.update((visit + 1) / (2 * last + 2))
    for name, values in found.items():
        values["ms"] = [round(median(each[name]), 3) for each in times]
    return found


def compared(gaussians: clod.Gaussians, view: clod.View, s: float) -> dict[str, float]:
    rendering = clod.render(gaussians, view.camera, s)
    in_view = int((rendering.kept & in_frustum(gaussians.means, view.camera)).sum())
    return {"in_view": in_view, "psnr": round(psnr(rendering.image, view.image), 3)}


@torch.no_grad()
def changes(methods: Methods, path: Sequence[clod.Camera]) -> dict[str, Row]:
    """Of each method: how its level of detail changes the image from frame to frame, RMS in levels of 255."""
    found = {}
    for name, of in methods.items():
        # The opacities and scales of frame j, from the camera of frame k.
        dialled = lru_cache(maxsize=3)(lambda j, of=of: (of(j)[0], dial(of(j)[0], path[j], of(j)[1])))

        def picture(k: int, j: int, dialled: Callable[[int], Any] = dialled) -> Tensor:
            gaussians, attenuated = dialled(j)
            return splat(gaussians, attenuated.drawn, path[k], growth=attenuated.growth)[0]

        if name != "base":  # which does not change
            with Console().meter(f"changes, {name}") as meter:
                result = popping.sweep(picture, distances(len(path)), lambda now, m=meter: m.update(now.share))
            each = [round(change, 4) for change in result.changes]
            found[name] = {"largest": result.largest, "at": result.at, "persistence": result.persistence, "each": each}
    return found


@torch.no_grad()
def equal(
    base: clod.Gaussians, settings: Mapping[str, Sequence[Shown]], town: Town, camera: clod.Camera, repeats: int
) -> dict[str, list[Row]]:
    """Milliseconds, Gaussians in view and PSNR of one frame: of the base, and of every setting of each method."""
    view = town.photograph(camera)
    shown = {("base", 0): (base, 1.0)}
    shown |= {(name, k): each for name, of in settings.items() for k, each in enumerate(of)}
    rows = {key: compared(gaussians, view, s) for key, (gaussians, s) in shown.items()}
    taken = timed({key: partial(clod.render, gaussians, camera, s) for key, (gaussians, s) in shown.items()}, repeats)
    found: dict[str, list[Row]] = {name: [] for name, _ in shown}
    for key, row in rows.items():
        found[key[0]].append({"ms": round(median(taken[key]), 3), **row})
    return found


if __name__ == "__main__":
    main()
