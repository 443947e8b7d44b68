"""Quality after adapting with few photographs or none, on real held-out photographs.

    python benchmarks/nophoto.py plush_half --iters 600 --kinds photographs placed
    python benchmarks/nophoto.py --table                  # the rows as a Markdown table
    python benchmarks/nophoto.py plush_half city:1000000 --cameras --sample 20000   # placing cameras alone
    python benchmarks/nophoto.py --city 4000000 --iters 200          # the whole command: time and memory

The kinds of views: ``photographs`` (real cameras and photographs), ``teacher`` (real cameras, renders of the
checkpoint), ``placed`` (placed cameras, renders of the checkpoint) and ``complemented`` (few photographs and pseudo
views, as clod-adapt combines them). Each run adds one row to ``results/nophoto.jsonl``; those of cameras and of the
command, on synthetic cities, go to ``results/sizes.jsonl``.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from statistics import fmean

import clod_adapter as clod
from adapt import at_shares
from city import city, city_cameras, perturb
from clod_adapter.initialization.coverage import reduced
from clod_adapter.training import camera_score
from clod_adapter.training.pseudo_views import LIGHTEST, STEPS_PER_PLACED, add_pseudo_views, render_pseudo_views, shown
from common import COMMAND, Process, append, arguments, checkpoint, stored, table
from common import photographs as photographs_of
from scaling import by_phase

import torch

FILE, SIZES = "nophoto.jsonl", "sizes.jsonl"
SAID = {"load": "Gaussians, SH degree", "cameras": "^no photographs", "plan": "^plan:", "train": "^trained "}
SCORED = 24  # placed cameras that are scored by all Gaussians
KINDS = ("photographs", "teacher", "placed", "complemented")
DIALS = (1.0, 2.0, 3.0, 5.0, 7.0)


def main() -> None:
    parser = arguments(__doc__, table=print_table)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS[:3])
    parser.add_argument("--few", type=int, metavar="K", help="of the photographs to train on, only K, evenly spread")
    parser.add_argument("--iters", type=int, help="training steps (default: by the number of views, as clod-adapt)")
    parser.add_argument("--max-sv", type=float, default=7.0)
    parser.add_argument("--cameras", action="store_true", help="place cameras only; a scene may be city:N")
    parser.add_argument("--sample", type=int, default=camera_score.SAMPLE, help="Gaussians that score a camera")
    parser.add_argument("--city", type=int, nargs="+", default=[], metavar="N", help="run the command on cities of N")
    parser.add_argument("--memory", default="8GB", help="of the command")
    args = parser.parse_args()
    camera_score.SAMPLE = args.sample
    for count in args.city:
        run_command(count, args.iters, args.max_sv, args.memory)
    if args.cameras:
        for scene in args.scenes:
            check_cameras(scene)
        return
    for scene in args.scenes:
        for kind in args.kinds:
            run(scene, kind, clod.AdaptConfig(iters=args.iters, max_sv=args.max_sv), args.few)


def run(scene: str, kind: str, config: clod.AdaptConfig, few: int | None) -> None:
    base, photographs = checkpoint(scene).gaussians, photographs_of(scene)
    if few:
        train = photographs.train[:: max(len(photographs.train) // few, 1)][:few]
        photographs = clod.Scene(train, photographs.test)
    base_row = clod.evaluate(base, photographs.test, [1.0])[0]
    began = time.perf_counter()
    views = photographs
    if kind == "teacher":
        # Of the views to train on alone; none is held out of them.
        rendered = render_pseudo_views(base, [view.camera for view in photographs.train])
        views = clod.Scene(tuple(view.at(view.camera) for view in (*rendered.train, *rendered.test)), ())
    if kind == "placed":
        views = render_pseudo_views(base, clod.place_cameras(base, seed=config.seed))
        config = config.lighter(LIGHTEST).for_views(len(views.train), STEPS_PER_PLACED)  # as the command does
    if kind == "complemented":
        views, config = add_pseudo_views(base, photographs, config)
    seconds = time.perf_counter() - began
    plan = clod.make_plan(base, views, config)
    adapted = plan.adapt(views)
    result = plan.whole(base, adapted.gaussians)
    rows = clod.evaluate(result, photographs.test, [s for s in DIALS if s <= config.max_sv])
    append(FILE, {
        "benchmark": "nophoto", "scene": scene, "kind": kind, "config": asdict(config), "views": len(views.train),
        "sample": camera_score.SAMPLE,
        "photographs": len(photographs.train), "base": base_row.as_dict(), "rows": [row.as_dict() for row in rows],
        "at_shares": at_shares(result, photographs.test), "steps": adapted.steps,
        "views_seconds": round(seconds, 2), "train_seconds": round(adapted.seconds, 2),
        "start_seconds": round(sum(plan.seconds.values()) + adapted.start_seconds, 2),
    })  # fmt: skip


def run_command(count: int, iters: int | None, max_sv: float, memory: str) -> None:
    """Runs clod-adapt on a city's checkpoint of SH degree 0 without photographs; adds its time and memory by phase."""
    with tempfile.TemporaryDirectory() as temporary:
        ply, out = Path(temporary) / "city.ply", Path(temporary) / "out.ply"
        clod.save(ply, perturb(city(count, sh_degree=0)))
        words = [ply, "--max-sv", max_sv, "--trim", "--memory", memory, "--out", out, "--json"]
        words += ["--iters", iters] if iters is not None else []
        run = Process([*COMMAND, *words], SAID)
        found = json.loads(run.out)
    peaks, cpu = by_phase(run, [*run.moments.items(), ("measure and write", run.seconds)])
    append(SIZES, {
        "benchmark": "command", "gaussians": count, "sh_degree": 0, "steps": found["steps"], "max_sv": max_sv,
        "limit": memory, "blocks": found["memory"]["blocks"], **run.cost(), "busy": round(os.getloadavg()[0], 2),
        "phases": found["seconds"], "phase_peaks": peaks, "phase_cpu": cpu, "plan": found["plan"]["decisions"],
        "base": found["base_rows"], "rows": found["rows"],
    })  # fmt: skip


def check_cameras(scene: str) -> None:
    """Places cameras by a sample of the Gaussians; scores them by all, and by what other cameras see.

    ``shown``: share of what the real cameras see (a city's: those of its photographs) that four placed ones show.
    """
    name, _, count = scene.partition(":")
    if count:
        gaussians, real = perturb(city(int(count))), city_cameras(40, 496, 368, count=int(count))
    else:
        gaussians, real = checkpoint(scene).gaussians, [view.camera for view in photographs_of(scene).train]
    began, cpu = time.perf_counter(), time.process_time()
    cameras = clod.place_cameras(gaussians)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    none = torch.zeros(cameras[0].height, cameras[0].width, 3, dtype=torch.uint8)
    views = [clod.View(camera, none) for camera in cameras]
    scores = [camera_score.score(gaussians, None, reduced(camera)) for camera in cameras[:SCORED]]
    append(SIZES, {
        "benchmark": "cameras", "scene": scene, "gaussians": len(gaussians), "sample": camera_score.SAMPLE,
        "seconds": round(seconds, 2), "cpu_seconds": round(cpu, 2), "cameras": len(cameras),
        "score": fmean(filter(math.isfinite, scores)), "empty": sum(map(math.isinf, scores)),
        "shown": shown(gaussians, views, real), "busy": round(os.getloadavg()[0], 2),
    })  # fmt: skip


def print_table() -> None:
    lines = []
    for row in stored(FILE):
        cells = [f"{r['psnr']:.2f} @ {r['kept_share']:.1%}" for r in row["rows"]]
        cells += [""] * (len(DIALS) - len(cells))
        cells.append(next((f"{r['psnr']:.2f}" for r in row.get("at_shares", []) if r["share"] == 0.12), ""))
        head = [row["scene"], row["steps"], row.get("photographs", "all"), row["kind"], f"{row['base']['psnr']:.2f}"]
        lines.append([*head, *cells])
    heads = ["scene", "steps", "photographs", "views", "base", *(f"s = {s:g}" for s in DIALS), "12 %"]
    print(table(heads, lines))


if __name__ == "__main__":
    main()
