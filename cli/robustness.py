"""``clod-adapt robustness``: adapts checkpoints at several ranges of the dial; writes a figure, a CSV and a JSON."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from clod_adapter._support.text import as_text
from clod_adapter._support.version import package_version
from clod_adapter.cameras import Scene
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.robustness import CellResult, adapt_at_range, baseline, scene_fingerprint
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.progress import Listener, Phase, Progress, Stopped
from clod_adapter.report.robustness_figure import robustness_figure

from .commands.robustness import result_files
from .commands.settings import make_configs
from .robustness_cells import Cell, cells_of
from .shared.alignment import align
from .shared.console import Console, Meter, clipped, duration, put
from .shared.inputs import on_device, pick_device, prepare_kernels, read_checkpoint, read_scene, with_filter
from .shared.measure import Stopwatch, machine, report_dials
from .shared.outputs import labels, write_report
from .shared.process import GracefulStop

COLUMNS = (
    "checkpoint", "max_sv", "within_range", "virtual_scale", "psnr", "ssim", "kept", "kept_share", "in_view", "frame_ms"
)  # fmt: skip
LONGEST = 16  # characters of a checkpoint's name in the table


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch, stop = Console(args.quiet), Stopwatch(), GracefulStop()
    outputs = result_files(Path(args.out))
    with watch.time("load"):
        checkpoints = read_checkpoints(args, console)
        scene = read_scene(args.images, console, checkpoints[0].origin)
    if not scene.test:
        raise ClodError(f"{args.images}: there are no held-out photographs to evaluate on; give at least two")
    device = checkpoints[0].gaussians.means.device
    with watch.time("kernels"):
        prepare_kernels(console, device, training=False)
    with watch.time("evaluate"):
        scene = aligned_scene(checkpoints, scene, args, console)
        checkpoints = [with_filter(each, args, console, scene.test) for each in checkpoints]
    cells = plan(args, checkpoints, scene)
    found = {cell.name: read for cell in cells if (read := cell.read())}
    missing = [cell for cell in cells if cell.name not in found]
    if found:
        console.say(f"{len(found)} of {len(cells)} cells are done already: {', '.join(found)}")
    if missing:
        with watch.time("kernels"):
            for screen_filter in dict.fromkeys(each.gaussians.screen_filter for each in checkpoints):
                prepare_kernels(console, device, screen_filter=screen_filter)
    with stop.listening():
        with watch.time("cells"):
            done = run_cells(missing, scene, console, stop)
        found |= done
        interrupted = len(done) < len(missing)
        if not found:
            raise Stopped("stopped before the first cell was finished")
        report = describe_cells(args, cells, found, interrupted, list(scene.notes)) | {
            "views": len(scene.test), "machine": machine(), "seconds": watch.report(),
            "outputs": {k: str(v) for k, v in outputs.items()},
        }  # fmt: skip
        write_outputs(report, outputs, Path(args.images).resolve().name)
    print_cells(report, outputs, watch)
    return report


def read_checkpoints(args: argparse.Namespace, console: Console) -> list[Checkpoint]:
    """Reads all checkpoints, relative to one origin."""
    found, device = list[Checkpoint](), pick_device(args.device, console)
    for path in args.ply:
        origin = found[0].origin if found else None
        found.append(on_device(read_checkpoint(path, console, args.activated, origin), device))
        if found[-1].gaussians.sigma_d is not None:
            console.say(f"  note: the dial of {path} is ignored")
    return found


def aligned_scene(checkpoints: Sequence[Checkpoint], scene: Scene, args: argparse.Namespace, console: Console) -> Scene:
    """The scene in the checkpoints' frame.

    Raises:
        ClodError: a checkpoint does not match, or they are in different frames.
    """
    for number, checkpoint in enumerate(checkpoints):
        scene, numbers = align(checkpoint, scene, args.images, console, required=not args.misaligned_ok)
        if number and numbers["frame"]:
            raise ClodError(f"{checkpoint.path}: in another frame than {checkpoints[0].path}; give it alone")
    return scene


def plan(args: argparse.Namespace, checkpoints: Sequence[Checkpoint], scene: Scene) -> list[Cell]:
    """All cells. Every range is measured at the dial values of the widest one and at its own end."""
    configs = make_configs(args)
    dials = sorted({*report_dials(configs[-1].max_sv), *(config.max_sv for config in configs)})
    seen, cells = scene_fingerprint(scene), list[Cell]()
    for checkpoint, label in zip(checkpoints, labels(args.ply), strict=True):
        cells += cells_of(label, checkpoint, configs, dials, seen, Path(args.out) / "cells")
    return cells


def run_cells(cells: Sequence[Cell], scene: Scene, console: Console, stop: GracefulStop) -> dict[str, dict[str, Any]]:
    """Runs the cells; returns those that were finished, by name."""
    found: dict[str, dict[str, Any]] = {}
    costs = [cell.cost(len(scene.train), len(scene.test)) for cell in cells]
    with closing(Meter(console, "robustness", slow=True)) as meter:
        for k, cell in enumerate(cells):
            before, weight = sum(costs[:k]) / sum(costs), costs[k] / sum(costs)

            def show(
                now: Progress, before: float = before, weight: float = weight, cell: Cell = cell, k: int = k
            ) -> None:
                share, text = position(cell, scene, now)
                meter.update(before + weight * share, f"{cell.name} ({k + 1}/{len(cells)}) {text}".rstrip())

            try:
                outcome = run_cell(cell, scene, stop.heeding(show))
            except Stopped:
                console.say(f"stopping: {cell.name} was not finished; the same command continues with it")
                break
            found[cell.name] = cell.write(outcome)
    return found


def run_cell(cell: Cell, scene: Scene, progress: Listener) -> CellResult:
    """Measures one cell.

    Raises:
        Stopped: ``progress`` returned False.
    """
    base = cell.checkpoint.gaussians
    if cell.config is None:
        return baseline(base, scene.test, cell.points, progress=progress)
    return adapt_at_range(
        base, scene, cell.config, cell.points, fingerprint=cell.checkpoint.fingerprint,
        origin=cell.checkpoint.origin, progress=progress,
    )  # fmt: skip


def position(cell: Cell, scene: Scene, now: Progress) -> tuple[float, str]:
    """The share of the cell that is done, by the costs of ``cell.cost``, and a text."""
    if cell.config is None:
        return now.share, "baseline"
    measuring = len(cell.points) * len(scene.test) / cell.cost(len(scene.train), len(scene.test))
    if now.phase == Phase.EVALUATION:
        return 1 - measuring * (1 - now.share), "measuring"
    begin, end = {Phase.IMPORTANCE: (0.0, 0.04), Phase.PRUNING_ORDER: (0.04, 0.05)}.get(now.phase, (0.05, 1.0))
    text = f"step {now.done}" if now.phase == Phase.TRAINING else "importance"
    return (1 - measuring) * (begin + (end - begin) * now.share), text


def describe_cells(
    args: argparse.Namespace,
    cells: Sequence[Cell],
    found: dict[str, dict[str, Any]],
    interrupted: bool,
    notes: list[str],
) -> dict[str, Any]:
    checkpoints = {cell.label: cell.checkpoint for cell in cells}
    return {
        "command": "robustness", "version": package_version(), "scene": args.images,
        "checkpoints": [
            {"checkpoint": label, "model": path, "count": len(c.gaussians), "sha256": c.fingerprint, "notes": c.notes}
            for path, (label, c) in zip(args.ply, checkpoints.items(), strict=True)
        ],
        "cells": [found[cell.name] for cell in cells if cell.name in found],
        "missing": [cell.name for cell in cells if cell.name not in found],
        "interrupted": interrupted, "notes": notes,
    }  # fmt: skip


def write_outputs(report: dict[str, Any], outputs: dict[str, Path], scene: str) -> None:
    title = f"{as_text(scene)}: the dial after the fact, by range; mean of {report['views']} held-out photographs"
    robustness_figure(outputs["png"], report["cells"], title)
    with atomic_path(outputs["csv"]) as part, open(part, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for cell in report["cells"]:
            name, limit = cell["checkpoint"], cell["max_sv"]
            for row in cell["rows"]:
                inside = "" if limit is None else row["virtual_scale"] <= limit
                writer.writerow({"checkpoint": name, "max_sv": limit or "base", "within_range": inside, **row})
    write_report(outputs["json"], report)


def print_cells(report: dict[str, Any], outputs: dict[str, Path], watch: Stopwatch) -> None:
    """One line per cell: its first and last row."""
    names = [clipped(cell["checkpoint"], LONGEST) for cell in report["cells"]]
    width = max(map(len, ["checkpoint", *names]))
    put(f"\n{'checkpoint':<{width}}  range     at the first              at the last")
    for checkpoint, cell in zip(names, report["cells"], strict=True):
        ends = [f"{row['psnr'] or 0:6.2f} dB @ {row['kept']:9,.0f}" for row in (cell["rows"][0], cell["rows"][-1])]
        name = "base" if cell["max_sv"] is None else f"[1, {cell['max_sv']:g}]"
        put(f"{checkpoint:<{width}}  {name:<8}  {ends[0]}    {ends[1]}")
    if report["missing"]:
        put(f"\nmissing: {', '.join(report['missing'])}; the same command continues")
    print()
    for path in outputs.values():
        print(path)
    print(f"\n{duration(watch.total())} in all")
