"""``clod-adapt eval``: quality, count and time at several dial values, on the held-out photographs."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from clod_adapter._support.version import package_version
from clod_adapter.cameras import Scene
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.perceptual import available_metrics
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.progress import Stopped

from .comparisons import Comparisons, compare
from .shared.alignment import align
from .shared.console import Console, put
from .shared.inputs import prepare_kernels, read_model_and_scene, with_filter
from .shared.measure import Stopwatch, choose_dials, machine, measure, solve_dials, table, with_frame_times
from .shared.pages import write_eval_page


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch = Console(args.quiet), Stopwatch()
    model, others, scene = prepare_inputs(args, console, watch)
    attenuation = model.gaussians.attenuation
    given, notes = solve_dials(args, model, [view.camera for view in scene.test], console)
    dials, beyond = choose_dials(given, attenuation)
    metrics, missing = available_metrics()
    notes += [*beyond, *missing]
    for note in notes:
        console.say(note)
    with watch.time("evaluate"):
        rows, interrupted = measure(model.gaussians, scene.test, dials, console, metrics=metrics)
        if interrupted and not rows:
            raise Stopped("stopped before the first row")
        if not interrupted:
            (rows,), rough, interrupted = with_frame_times([(model.gaussians, rows)], scene.test, console)
            notes += rough
    put(table(rows))
    base = others[args.base] if args.base else None
    against, comparisons = {path: others[path] for path in args.against}, Comparisons()
    if not interrupted:
        with watch.time("comparisons"):
            comparisons = compare(model.gaussians, rows, base, against, scene, metrics, console, args.popping)
        interrupted = comparisons.interrupted
    put(comparisons.text(), end="")
    report: dict[str, Any] = {
        "command": "eval", "version": package_version(), "model": args.model, "scene": args.images,
        "base_count": len(model.gaussians), "sh_degree": model.gaussians.sh_degree, "views": len(scene.test),
        "rows": [row.as_dict() for row in rows], "base": args.base, **comparisons.report(),
        "interrupted": interrupted, "attenuation": asdict(attenuation) if attenuation else None,
        "notes": [*model.notes, *scene.notes, *notes, *comparisons.notes], "machine": machine(),
        "device": str(model.gaussians.means.device), "seconds": watch.report(),
    }  # fmt: skip
    return report | write_eval_page(args, report, model.gaussians, base, scene, console)


def prepare_inputs(
    args: argparse.Namespace, console: Console, watch: Stopwatch
) -> tuple[Checkpoint, dict[str, Gaussians], Scene]:
    """The model, the files of --base and --against by path, and the scene; all with their screen-space filters."""
    with watch.time("load"):
        paths = [*([args.base] if args.base else []), *args.against]
        model, others, scene, device = read_model_and_scene(args, console, paths)
    if not scene.test:
        raise ClodError(f"{args.images}: there are no held-out photographs to evaluate on; give at least two")
    with watch.time("kernels"):
        prepare_kernels(console, device, training=bool(args.base))
    scene, _ = align(model, scene, args.images, console, required=False)
    model = with_filter(model, args, console, scene.test)
    if model.gaussians.sigma_d is None:
        console.say(f"{args.model} has no sigma_d, so every dial value renders all of it")
    return model, {p: with_filter(each, args, console, scene.test).gaussians for p, each in others.items()}, scene
