"""``clod-adapt eval``: quality, count and time over dial values, on the held-out photographs."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from clod_adapter.cameras import View
from clod_adapter.cli.console import Console, announced_compiling
from clod_adapter.cli.files import read_checkpoint, read_scene
from clod_adapter.cli.report import Stopwatch, machine, table
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.evaluate import Row, evaluate
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.version import package_version

SUMMARY = "Measure quality, count and time at some dial values."
DESCRIPTION = "Measure quality, Gaussians kept and frame time at several dial values."
USAGE = "MODEL.ply --images DIR [--sv S [S ...]] [options]"
EPILOG = """\
All numbers are over the held-out photographs (every 8th by name):
  PSNR, SSIM  means against the photographs
  kept        Gaussians that the dial leaves in, and their share of all
  in view     those of them that have their centre in the picture
  frame ms    median time to render a picture
A checkpoint without a dial shows the same at every value: the baseline.

Ctrl-C skips the dial values that are not finished (exit code 0, "interrupted":
true); before the first one is, there is nothing to print (exit code 130).

examples:
  clod-adapt eval garden_clod.ply --images garden
  clod-adapt eval garden.ply --images garden --sv 1
  clod-adapt eval garden_clod.ply --images garden --sv 1 4 --json > eval.json
"""
DIALS = (1.0, 2.0, 3.0, 5.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL.ply", help="an adapted file, or a plain one as the baseline")
    parser.add_argument("--images", metavar="DIR", required=True, help="the scene: photographs and their COLMAP model")
    parser.add_argument(
        "--sv", metavar="S", type=float, nargs="+",
        help="dial values, 1 (full quality) and up (default: 1 2 3 5 as far as trained, and the last one trained)",
    )  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch = Console(args.quiet), Stopwatch()
    for virtual_scale in args.sv or ():
        if not 1 <= virtual_scale < math.inf:
            raise ClodError(f"--sv has {virtual_scale:g}, dial values must be at least 1 (1 is full quality)")
    with watch.time("load"):
        model = read_checkpoint(args.model, console)
        scene = read_scene(args.images, console)
    if not scene.test:
        raise ClodError(f"{args.images}: there are no held-out photographs to evaluate on; give at least two")
    if model.gaussians.sigma_d is None:
        console.say(f"{args.model} has no sigma_d: every dial value shows it in full")
    attenuation = model.gaussians.attenuation
    dials, notes = choose_dials(args.sv, attenuation)
    for note in notes:
        console.say(note)
    with watch.time("evaluate"), announced_compiling(console):
        rows, interrupted = measure(model.gaussians, scene.test, dials, console)
    if interrupted and not rows:
        raise KeyboardInterrupt
    print(table(rows))
    return {
        "command": "eval", "version": package_version(), "model": args.model, "scene": args.images,
        "base_count": len(model.gaussians), "sh_degree": model.gaussians.sh_degree, "views": len(scene.test),
        "rows": [row.as_dict() for row in rows], "interrupted": interrupted,
        "attenuation": asdict(attenuation) if attenuation else None,
        "notes": [*model.notes, *scene.notes, *notes], "machine": machine(),
        "device": str(model.gaussians.means.device), "seconds": watch.report(),
    }  # fmt: skip


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
) -> tuple[list[Row], bool]:
    """The rows of the dial values, none where there are no views, and whether Ctrl-C cut them short."""
    rows: list[Row] = []
    with console.meter(label) as meter:
        try:
            for i, virtual_scale in enumerate(virtual_scales if views else ()):

                def report(done: int, total: int, before: int = i, s: float = virtual_scale) -> None:
                    meter.update((before + done / total) / len(virtual_scales), f"s={s:g}")

                rows += evaluate(gaussians, views, [virtual_scale], progress=report)
        except KeyboardInterrupt:
            return rows, True
    return rows, False
