"""Quality against the time of frames, of dials that reduce the count of Gaussians and the cost of rendering.

    python benchmarks/cost.py --train plush_half bonsai146   # adapts with either target; the files stay in cache/
    python benchmarks/cost.py plush_half bonsai146           # measures them: frames of all in turn, on a quiet machine
    python benchmarks/cost.py --fit plush_half               # the cost's weights, fitted to times of frames
    python benchmarks/cost.py --table                        # the rows as a Markdown table
    python benchmarks/cost.py --interpolated                 # frame times from the cost and the times at both ends

A row of ``results/cost.jsonl`` has for each target and dial value, as means over the held-out views: PSNR, the shares
kept of Gaussians and of the base's cost, and the median time of a frame. The same of the base; of the base with a dial
without effect (``idle``), whose frames take longer by what the dial takes; and of a frame with nothing in it
(``empty``). ``same_quality``: the time at which the cost target has the PSNR that the count target has at a dial value,
linear between the dial values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from statistics import fmean, median

import clod_adapter as clod
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.rasterizers import cpu
from clod_adapter.training.target_cost import DRAWN, TILE, view_cost
from common import CACHE, Row, append, arguments, checkpoint, photographs, stored, table, timed

import numpy as np
import torch

FILE = "cost.jsonl"
TARGETS = ("count", "cost")
DIALS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0)
COMPARED = (3.0, 4.0, 5.0, 7.0)
MAX_SV, THREADS, REPEATS = 7.0, 2, 5


def main() -> None:
    parser = arguments(__doc__, table=print_table)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--train", action="store_true", help="adapt and store the files, measure nothing")
    parser.add_argument("--fit", action="store_true", help="fit the weights of the cost to times instead")
    parser.add_argument("--interpolated", action="store_true", help="errors of frame times by the stored costs")
    parser.add_argument("--iters", type=int, default=clod.AdaptConfig().steps)
    parser.add_argument("--targets", nargs="+", default=TARGETS)
    args = parser.parse_args()
    if args.interpolated:
        print_interpolated()
    elif not args.scenes:
        parser.error("give scenes, or --interpolated")
    for scene in args.scenes:
        if args.train:
            for target in args.targets:
                train(scene, target, args.iters)
        else:
            torch.set_num_threads(1 if args.fit else THREADS)
            append(FILE, fitted(scene) if args.fit else compared(scene, args.iters))


def settings(target: str, iters: int) -> clod.AdaptConfig:
    return clod.AdaptConfig(max_sv=MAX_SV, iters=iters, target=target)


def file_of(scene: str, target: str, iters: int) -> str:
    return str(CACHE / f"cost_{scene.replace('/', '_')}_{target}_{iters}.ply")


def train(scene: str, target: str, iters: int) -> None:
    base, views, config = checkpoint(scene).gaussians, photographs(scene), settings(target, iters)
    plan = clod.make_plan(base, views, config)
    CACHE.mkdir(parents=True, exist_ok=True)
    clod.save(file_of(scene, target, iters), plan.whole(base, plan.adapt(views).gaussians))


def compared(scene: str, iters: int) -> Row:
    """Both targets and the base, from one run."""
    base, views = checkpoint(scene).gaussians, photographs(scene).test
    models = {target: clod.load(file_of(scene, target, iters)).gaussians for target in TARGETS}
    cases = [("base", base, 1.0), ("idle", idle(base), 1.0), ("empty", empty(base), 1.0)]
    cases += [(target, models[target], s) for target in TARGETS for s in DIALS]
    times: list[list[float]] = [[] for _ in cases]
    for view in views:
        jobs = {str(k): partial(clod.render, model, view.camera, s) for k, (_, model, s) in enumerate(cases)}
        for taken, more in zip(times, timed(jobs, REPEATS).values(), strict=True):
            taken += more
    whole = fmean(view_cost(base, view.camera) for view in views)
    found: dict[str, list[Row]] = {name: [] for name, *_ in cases}
    for (name, model, s), taken in zip(cases, times, strict=True):
        row = clod.evaluate(model, views, [s])[0]
        cost = fmean(view_cost(model, view.camera, s) for view in views) / whole
        found[name].append(
            {"virtual_scale": s, "psnr": row.psnr, "kept": row.kept_share, "cost": cost, "frame_ms": median(taken)}
        )
    return {
        "benchmark": "cost", "kind": "targets", "scene": scene, "threads": THREADS, "views": len(views),
        "config": asdict(settings("cost", iters)),
        **{name: rows if name in TARGETS else rows[0] for name, rows in found.items()},
        "same_quality": same_quality(found["count"], found["cost"]),
    }  # fmt: skip


def idle(base: clod.Gaussians) -> clod.Gaussians:
    """The base with a dial without effect: its frames take longer by what the dial itself takes."""
    zero = torch.zeros(len(base))
    return clod.with_dial(base, zero + SIGMA_MAX, clod.AttenuationConfig(tau=1e-6, max_sv=MAX_SV), zero)


def empty(base: clod.Gaussians) -> clod.Gaussians:
    """Sixteen of them, too faint to be drawn: what a frame takes at least."""
    few = base.select(torch.arange(16))
    return few.replace(opacity_logits=torch.full((16,), -20.0))


def same_quality(count: Sequence[Row], cost: Sequence[Row]) -> list[Row]:
    """For the PSNR of the count target at each of COMPARED, the frame times of both; None where it is not reached.

    Dial values of the cost target at which a frame takes longer than at another one without being better do not count.
    """
    useful = [row for row in cost if not any(beats(other, row) for other in cost)]
    by_psnr = sorted(useful, key=lambda row: row["psnr"])
    psnr, ms = ([row[name] for row in by_psnr] for name in ("psnr", "frame_ms"))
    found = []
    for row in (row for row in count if row["virtual_scale"] in COMPARED):
        inside = psnr[0] <= row["psnr"] <= psnr[-1]
        at = float(np.interp(row["psnr"], psnr, ms)) if inside else None
        faster = row["frame_ms"] / at if at else None
        found.append({**row, "cost_frame_ms": at, "times_faster": faster})
    return found


def beats(one: Row, other: Row) -> bool:
    return one["frame_ms"] < other["frame_ms"] and one["psnr"] >= other["psnr"]


def fitted(scene: str) -> Row:
    """Microseconds a Gaussian, a tile and a block, by least squares over dial values and views, on one thread."""
    base, views = checkpoint(scene).gaussians, photographs(scene).test[:4]
    models = [base, clod.load(file_of(scene, "count", clod.AdaptConfig().steps)).gaussians]
    counts, times = [], []
    for model, dials in zip(models, ((1.0,), DIALS), strict=True):
        for s in dials:
            for view in views:
                tiles, blocks = cpu.work(model, view.camera, s)
                counts.append([1.0, float((tiles > 0).sum()), float(tiles.sum()), float(blocks.sum())])
                times.append(1e3 * median(timed({"": partial(clod.render, model, view.camera, s)}, REPEATS)[""]))
    weights, *_ = np.linalg.lstsq(np.array(counts), np.array(times), rcond=None)
    own = np.array(counts) @ [0, DRAWN, TILE, 1]
    named = dict(zip(("frame", "drawn", "tile", "block"), weights.tolist(), strict=True))
    correlation = float(np.corrcoef(own, times)[0, 1])
    return {"benchmark": "cost", "kind": "fit", "scene": scene, "microseconds": named, "correlation": correlation}


def print_table() -> None:
    lines = []
    for row in stored(FILE):
        if row["kind"] == "targets":
            base = row["base"]
            for target in TARGETS:
                for at in row[target]:
                    share = at["frame_ms"] / base["frame_ms"]
                    kept, cost = f"{at['kept']:.1%}", f"{at['cost']:.1%}"
                    cells = [f"{at['virtual_scale']:g}", f"{at['psnr']:.2f}", kept, cost]
                    lines.append([row["scene"], target, *cells, f"{at['frame_ms']:.1f}", f"{share:.0%}"])
    print(table(["scene", "target", "s", "PSNR", "Gaussians", "cost", "frame, ms", "of the base's"], lines))


def print_interpolated() -> None:
    """How far the times between the ends of the dial are from ``a + b cost`` with the times at both ends."""
    lines = []
    for row in stored(FILE):
        if row["kind"] == "targets":
            for target in TARGETS:
                cost, ms = (np.array([at[name] for at in row[target]]) for name in ("cost", "frame_ms"))
                error = np.interp(cost, cost[[-1, 0]], ms[[-1, 0]]) / ms - 1
                worst = f"{abs(error).max():.1%}"
                lines.append([row["commit"], row["scene"], target, f"{np.median(abs(error)):.1%}", worst])
    print(table(["commit", "scene", "target", "median error", "largest"], lines))


if __name__ == "__main__":
    main()
