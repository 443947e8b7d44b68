"""``clod-adapt eval``: quality, count and time over dial values, on the held-out photographs."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from clod_adapter.errors import ClodError
from clod_adapter.evaluation.perceptual import available_metrics
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.progress import Stopped
from clod_adapter.version import package_version

from .comparisons import Comparisons, compare
from .shared.antialiasing import with_filter
from .shared.budgets import solve_dials
from .shared.console import Console
from .shared.devices import on_device, pick_device
from .shared.inputs import read_checkpoint, read_scene
from .shared.kernels import prepare_kernels
from .shared.measure import choose_dials, measure
from .shared.pages import write_eval_page
from .shared.report import Stopwatch, machine, table


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch = Console(args.quiet), Stopwatch()
    with watch.time("load"):
        device = pick_device(args.device, console)
        model = on_device(read_checkpoint(args.model, console, args.activated), device)

        def beside(path: str) -> Checkpoint:
            return on_device(read_checkpoint(path, console, args.activated, model.origin), device)

        read = {path: beside(path) for path in [*([args.base] if args.base else []), *args.against]}
        scene = read_scene(args.images, console, model.origin)
    if not scene.test:
        raise ClodError(f"{args.images}: there are no held-out photographs to evaluate on; give at least two")
    with watch.time("kernels"):
        prepare_kernels(console, device, training=bool(args.base))
    model = with_filter(model, args, console, scene.test)
    shown = {path: with_filter(each, args, console, scene.test).gaussians for path, each in read.items()}
    base = shown[args.base] if args.base else None
    others = {path: shown[path] for path in args.against}
    if model.gaussians.sigma_d is None:
        console.say(f"{args.model} has no sigma_d: every dial value shows it in full")
    attenuation = model.gaussians.attenuation
    given, solved = solve_dials(args, model, [view.camera for view in scene.test], console)
    dials, notes = choose_dials(given, attenuation)
    perceptual, missing = available_metrics()
    notes = [*solved, *notes, *missing]
    for note in notes:
        console.say(note)
    with watch.time("evaluate"):
        rows, interrupted = measure(model.gaussians, scene.test, dials, console, metrics=perceptual)
    if interrupted and not rows:
        raise Stopped("stopped before the first row")
    print(table(rows))
    comparisons = Comparisons()
    if not interrupted:
        with watch.time("comparisons"):
            comparisons = compare(model.gaussians, rows, base, others, scene, perceptual, console, args.popping)
        interrupted = comparisons.interrupted
    print(comparisons.text(), end="")
    report: dict[str, Any] = {
        "command": "eval", "version": package_version(), "model": args.model, "scene": args.images,
        "base_count": len(model.gaussians), "sh_degree": model.gaussians.sh_degree, "views": len(scene.test),
        "rows": [row.as_dict() for row in rows], "base": args.base, **comparisons.report(),
        "interrupted": interrupted, "attenuation": asdict(attenuation) if attenuation else None,
        "notes": [*model.notes, *scene.notes, *notes, *comparisons.notes], "machine": machine(),
        "device": str(model.gaussians.means.device), "seconds": watch.report(),
    }  # fmt: skip
    return report | write_eval_page(args, report, model.gaussians, base, scene, console)
