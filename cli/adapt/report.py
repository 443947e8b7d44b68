"""The end of the pipeline: measures and writes the result, and reports."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

from clod_adapter._support.version import package_version
from clod_adapter.adapter import Adapter
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.adapter_file import save_adapter
from clod_adapter.io.atomic import atomic_paths
from clod_adapter.io.checkpoint import Checkpoint, save

from ..shared.console import command_line, duration, put
from ..shared.measure import Stopwatch, calibrate, machine, table
from ..shared.outputs import AdaptFiles, size, write_report
from ..shared.pages import AdaptPage
from ..shared.process import GracefulStop
from .inputs import Inputs
from .processes import describe_processes
from .result import Measurements, Result, measure_result
from .setup import Setup

# dB: of s = 1 below the base, and against the checkpoint's renderings without photographs, what is told and what fails.
LOST, ENOUGH = (0.1, 1.0), (33.0, 25.0)


def finish(
    setup: Setup, inputs: Inputs, result: Result, page: AdaptPage | None, written: Callable[[bool], None]
) -> dict[str, Any]:
    """Measures the result, writes it once, and returns the report.

    Args:
        written: called once the files are written, with whether the run is complete.
    """
    # After a Ctrl-C that ended training the next one aborts, as its message says.
    stop = GracefulStop(setup.stop.aborts, setup.stop.presses if result.adapted.interrupted else 0)
    with stop.listening():  # a first Ctrl-C ends the measurement, and lets the writing finish
        measured = measure_result(setup, inputs, result, stop)
        report = write_result(setup, inputs, result, measured)
    written(not result.adapted.interrupted and not measured.interrupted)
    if page and (measured.interrupted or stop.requests):
        setup.console.say("interrupted: the page of --report was not written")
    elif page:  # after the report
        report = add_page(setup, result, page, report)
    shown = table(measured.rows, measured.base, measured.plain) if measured.rows else ""
    print_summary(setup.outputs, shown, setup.args, setup.watch)
    if "loss" in report:
        setup.console.say(f"\nwarning: {report['loss']}")
    return report


def write_result(setup: Setup, inputs: Inputs, result: Result, measured: Measurements) -> dict[str, Any]:
    """Writes the three files, and returns the report."""
    outputs, adapter = setup.outputs, result.adapter
    if measured.rows and not measured.interrupted:
        against = teacher(setup.args)
        try:
            table_of = calibrate(measured.rows, result.gaussians, inputs.scene, against, result.base.origin)
            adapter = replace(adapter, calibration=table_of)
        except ClodError as error:
            setup.console.say(f"the files have no calibration, so --fps and --psnr-drop will not work: {error}")
    report = describe_run(setup, inputs, result, measured)
    with setup.console.status(f"writing {outputs.ply} ..."):
        report = write_files(result.base, adapter, result.gaussians, outputs, report)
    setup.console.say(f"wrote {outputs.adapter} and {outputs.ply}")
    return report


def write_files(
    base: Checkpoint, adapter: Adapter, result: Gaussians, outputs: AdaptFiles, report: dict[str, Any]
) -> dict[str, Any]:
    """Writes the three files; returns the report with the calibration and the sizes of the other two.

    All three are complete, beside those of an earlier run, before the first replaces its predecessor. Only a kill
    between two renames leaves files of different runs; if one cannot be written, the earlier files stay.
    """
    with atomic_paths(outputs.adapter, outputs.ply, outputs.report) as (small, large, about):
        save_adapter(small, adapter)
        save(large, result, base, version=adapter.version, calibration=adapter.calibration)
        sizes = {"adapter_bytes": small.stat().st_size, "ply_bytes": large.stat().st_size}
        full = report | {"calibration": adapter.calibration and adapter.calibration.as_dict(), **sizes}
        write_report(about, full)
    return full


def describe_run(setup: Setup, inputs: Inputs, result: Result, measured: Measurements) -> dict[str, Any]:
    """The report, except the sizes of the files."""
    args, adapted, adapter, plan = setup.args, result.adapted, result.adapter, result.plan
    late = "the measurements were interrupted: only the dial values that were finished are reported"
    notes = [*result.base.notes, *inputs.scene.notes, *inputs.notes, *result.notes, *measured.notes]
    if measured.interrupted:
        setup.console.say(late)
        notes.append(late)
    report = {
        "command": "adapt", "version": package_version(), "model": args.ply, "scene": args.images,
        "teacher": teacher(args), "screen_filter": asdict(result.gaussians.screen_filter),
        "base_count": adapter.base_count, "config": adapter.config, "attenuation": asdict(adapter.attenuation),
        "steps": adapted.steps, "interrupted": adapted.interrupted, "machine": machine(),
        "processes": describe_processes(adapted, inputs.config.batch), "outputs": setup.outputs.names(),
        "sh_degree": result.gaussians.sh_degree, "device": str(result.gaussians.means.device),
        "seconds": seconds(setup, result), "resumed_from": setup.resumed and setup.resumed.state.steps,
        "alignment": inputs.alignment, "notes": notes, "base_rows": [row.as_dict() for row in measured.base],
        "rows": [row.as_dict() for row in measured.rows],
        "detached_row": measured.plain[0].as_dict() if measured.plain else None,
        "watched": adapted.watched and asdict(adapted.watched), "plan": plan.as_dict(),
        "memory": inputs.memory and asdict(inputs.memory),
    }  # fmt: skip
    line, failed = ("", False) if report["interrupted"] else judge(measured, args.images is not None)
    failed = adapted.failed is not None or failed and not args.accept_loss
    return report | ({"loss": line} if line else {}) | ({"exit_code": 1} if failed else {})


def judge(measured: Measurements, photographs: bool) -> tuple[str, bool]:
    """What is wrong with s = 1 and what to do, empty if nothing is; and whether the result has failed."""
    full = [row.psnr for row in measured.rows if row.virtual_scale == 1]
    if not full or not measured.base:
        return "", False
    if photographs:
        lost = measured.base[0].psnr - full[0]
        line = f"s = 1 is {lost:.2f} dB below the base on the held-out photographs"
        bad, failed = not lost <= LOST[0], not lost <= LOST[1]
    else:
        line = f"s = 1 has {full[0]:.2f} dB against the checkpoint's own renderings"
        bad, failed = not full[0] >= ENOUGH[0], not full[0] >= ENOUGH[1]
    more = "" if photographs else ", or give the photographs (--images)"
    return (f"{line}:\ntrain longer (--iters){more}, or keep the base for full quality" if bad else ""), failed


def seconds(setup: Setup, result: Result) -> dict[str, float]:
    """Wall times by phase."""
    plan, adapted = result.plan, result.adapted
    times = {
        "plan": sum(plan.seconds.values()) - plan.seconds["start"], "start": adapted.start_seconds,
        "train": adapted.seconds,
    }  # fmt: skip
    return {name: round(value, 3) for name, value in times.items()} | setup.watch.report()


def teacher(args: argparse.Namespace) -> str:
    return "checkpoint" if args.images is None else "photographs"


def add_page(setup: Setup, result: Result, page: AdaptPage, report: dict[str, Any]) -> dict[str, Any]:
    """Writes the page, and the report again with its files."""
    path = setup.outputs.ply.with_suffix(".html")
    with setup.watch.time("page"):
        changes = page.write(path, report, result.gaussians, result.adapted.start_seconds)
    report = report | changes | {"seconds": seconds(setup, result)}
    write_report(setup.outputs.report, report)
    return report


def print_summary(outputs: AdaptFiles, measured: str, args: argparse.Namespace, watch: Stopwatch) -> None:
    """Prints the measurements, the files, and what to do next."""
    if measured:
        put(f"\n{measured}\n")
        if "plain" in measured:
            put(f"plain: {outputs.ply} in a viewer that does not know the dial\n")
    for path in vars(outputs).values():
        put(f"{size(path):>9}  {path}")
    put(f"\n{duration(watch.total())} in all; next:")
    model = shlex.quote(str(outputs.ply))
    images = [] if args.images is None else [f"--images {shlex.quote(args.images)}"]
    print(command_line(f"clod-adapt view {model}", f"--base {shlex.quote(args.ply)}", *images))
    if images:
        sv = " ".join(f"{s:g}" for s in sorted({1.0, args.max_sv}))
        print(command_line(f"clod-adapt eval {model}", *images, f"--sv {sv}"))
