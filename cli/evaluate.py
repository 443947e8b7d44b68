"""``clod-adapt eval``: quality, count and time over dial values, on the held-out photographs."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from clod_adapter.cameras import View
from clod_adapter.cli.antialiasing import with_filter
from clod_adapter.cli.budgets import solve_dials
from clod_adapter.cli.console import Console
from clod_adapter.cli.devices import on_device, pick_device
from clod_adapter.cli.inputs import read_checkpoint, read_scene
from clod_adapter.cli.instruments import Instruments
from clod_adapter.cli.interrupts import GracefulStop
from clod_adapter.cli.kernels import prepare_kernels
from clod_adapter.cli.pages import write_eval_page
from clod_adapter.cli.report import Stopwatch, machine, table
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.evaluate import Row, evaluate
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.ply import Checkpoint
from clod_adapter.io.version import package_version
from clod_adapter.perceptual import Metric, available_metrics

DIALS = (1.0, 2.0, 3.0, 5.0)


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
        raise KeyboardInterrupt
    print(table(rows))
    instruments = Instruments(model.gaussians, scene, perceptual, console)
    if not interrupted:
        with watch.time("instruments"):
            interrupted = instruments.run(rows, base, others, args.popping)
    print(instruments.text(), end="")
    report: dict[str, Any] = {
        "command": "eval", "version": package_version(), "model": args.model, "scene": args.images,
        "base_count": len(model.gaussians), "sh_degree": model.gaussians.sh_degree, "views": len(scene.test),
        "rows": [row.as_dict() for row in rows], "base": args.base, **instruments.report(),
        "interrupted": interrupted, "attenuation": asdict(attenuation) if attenuation else None,
        "notes": [*model.notes, *scene.notes, *notes, *instruments.notes], "machine": machine(),
        "device": str(model.gaussians.means.device), "seconds": watch.report(),
    }  # fmt: skip
    return report | write_eval_page(args, report, model.gaussians, base, scene, console)


def choose_dials(given: list[float] | None, attenuation: AttenuationConfig | None) -> tuple[list[float], list[str]]:
    """The dial values to measure, and a note where they are beyond what the file was trained for."""
    trained = attenuation.max_sv if attenuation else None
    if given is None:
        return [s for s in DIALS if trained is None or s < trained] + ([trained] if trained else []), []
    if trained is None or max(given) <= trained:
        return given, []
    return given, [f"trained up to s = {trained:g}; beyond that nothing was learned"]


def measure(
    gaussians: Gaussians,
    views: Sequence[View],
    virtual_scales: Sequence[float],
    console: Console,
    label: str = "measure",
    metrics: Mapping[str, Metric] | None = None,
) -> tuple[list[Row], bool]:
    """The rows of the dial values, none where there are no views, and whether Ctrl-C cut them short."""
    rows, stop = list[Row](), GracefulStop()  # raised between frames: within a kernel it would be a SystemError
    with console.meter(label) as meter, stop.listening():
        try:
            for i, virtual_scale in enumerate(virtual_scales if views else ()):

                def report(done: int, total: int, before: int = i, s: float = virtual_scale) -> None:
                    meter.update((before + done / total) / len(virtual_scales), f"s={s:g}")
                    if stop.requests:
                        raise KeyboardInterrupt

                rows += evaluate(gaussians, views, [virtual_scale], metrics=metrics, progress=report)
        except KeyboardInterrupt:
            return rows, True
    return rows, stop.requests > 0
