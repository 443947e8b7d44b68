"""``clod-adapt``: gives a checkpoint its dial, and writes the extended file, the adapter and a
report.
"""

import argparse
import shlex
from contextlib import closing
from dataclasses import asdict, replace

from clod_adapter import Plan, Progress, Result, detach
from clod_adapter._kernels.memory import release
from clod_adapter._support.machine import machine
from clod_adapter._support.text import package_version
from clod_adapter.evaluation.calibrate import report_dials
from clod_adapter.io.atomic import atomic_paths
from clod_adapter.pipeline import extract_result, with_quality_table
from clod_adapter.progress import GracefulStop
from clod_adapter.training.state import Adapted

from ..shared.console import ProgressDisplay, duration
from ..shared.measure import by_dial, comparable, measure, table
from ..shared.outputs import Report, size, write_report
from ..shared.pages import AdaptPage
from ..shared.process import ignore_signals, launched
from .prepare import Run, against_forecast, decide, forecast
from .processes import BACKENDS, explain, must_exit_soon, training_group

# Limits in dB, the one beyond which s = 1 has a warning, and the one beyond which the run fails:
# LOST below the base on photographs, ENOUGH against the checkpoint's renderings without them.
LOST, ENOUGH = (0.1, 1.0), (33.0, 25.0)


def adapt(args: argparse.Namespace) -> Report:
    """Plans, trains, writes and reports."""
    run = Run(args)
    run.read()
    page = (
        AdaptPage(run.base.gaussians, run.scene, run.config, run.console) if args.report else None
    )
    run.identify()
    run.measure_base()
    # until training has ended, so that a Ctrl-C loses nothing
    with run.stop.listening(), run.saver.rescuing():
        result = make_result(run, *train(run, page))
    with run.saver.rescuing():
        return finish(run, result, page)


def train(run: Run, page: AdaptPage | None) -> tuple[Plan, Adapted]:
    """Plans and trains; the result is of all Gaussians."""
    scene, saver = run.scene, run.saver
    display = ProgressDisplay(run.console, run.stop)
    plan = decide(run, display)
    forecast(run, plan)

    def show(now: Progress) -> bool:
        if page:
            page(now, plan.restore_excluded)
        return display(now)

    with closing(display), training_group(plan, scene, saver.state, display) as group:
        adapted = plan.adapt(scene, saver.saving(show), saver.state, group)
    saver.keep()
    how = "trained"
    if adapted.interrupted:
        how = "ended after" if adapted.failed else "interrupted after"
    run.console.say(f"{how} {adapted.steps} steps, {duration(adapted.seconds)}")
    release()
    return plan, adapted


def make_result(run: Run, plan: Plan, adapted: Adapted) -> Result:
    """Extracts the adapter, and applies it to the base."""
    if must_exit_soon(adapted):
        ignore_signals()
    if adapted.lost:
        adapted = replace(adapted, lost=explain(adapted.lost))
    run.console.note(*adapted.notes)
    result = extract_result(run.base, run.scene, run.against, plan, adapted, run.config)
    return replace(result, base_rows=run.base_rows)


def finish(run: Run, result: Result, page: AdaptPage | None) -> Report:
    """Measures the result, writes it once, and returns the report."""
    interrupted, console, outputs = result.adapted.interrupted, run.console, run.outputs
    # After a Ctrl-C that ended training the next one aborts, as its message says.
    stop = GracefulStop(run.stop.aborts, run.stop.presses if interrupted else 0)
    with stop.listening():  # a first Ctrl-C ends the measurement, and lets the writing finish
        result = measure_result(run, result, stop)
        report = write_result(run, result)
    complete = not interrupted and not run.cut
    run.saver.close(complete)
    if page and (run.cut or stop.requests):
        console.say("interrupted: the page of --report was not written")
    elif page:  # after the report, which it changes
        path = outputs.ply.with_suffix(".html")
        page.write(path, report, result.gaussians, result.adapted.start_seconds)
        write_report(outputs.report, report)
    print_summary(run, result)
    if "loss" in report:
        console.say(f"\nwarning: {report['loss']}")
    return report


def measure_result(run: Run, result: Result, stop: GracefulStop) -> Result:
    """Measures the result on the held-out views, unless the run is to end now.

    That is after a Ctrl-C that came when training was complete, and if the launcher ends the
    processes.
    """
    views, console = run.scene.test, run.console
    if run.stop.requests > 0 and not result.adapted.interrupted or must_exit_soon(result.adapted):
        return result
    detached = detach(result.gaussians)
    with run.watch.time("evaluate"):
        rows = measure(result.gaussians, views, report_dials(run.config.max_sv), console, stop)
        plain = measure(detached, views, [1.0], console, stop, "plain")
        measured = [
            (run.base.gaussians, run.base_rows),
            (result.gaussians, rows),
            (detached, plain),
        ]
        base_rows, rows, plain = comparable(measured, views, console, stop)
    run.cut = stop.requests > 0
    result = replace(result, base_rows=base_rows, rows=rows, plain=plain)
    return result if run.cut or not rows else with_quality_table(result, console.say)


def write_result(run: Run, result: Result) -> Report:
    """Writes the three files, all before the first replaces that of an earlier run, and returns the
    report.
    """
    outputs, console, quality_table = run.outputs, run.console, result.adapter.quality_table
    report = describe(run, result)
    with (
        console.status(f"writing {outputs.ply} ..."),
        atomic_paths(outputs.adapter, outputs.ply, outputs.report) as (small, large, about),
    ):
        result.write(large, small)
        report["calibration"] = quality_table and quality_table.as_dict()
        report |= {"adapter_bytes": small.stat().st_size, "ply_bytes": large.stat().st_size}
        write_report(about, report)
    console.say(f"wrote {outputs.adapter} and {outputs.ply}")
    return report


def describe(run: Run, result: Result) -> Report:
    """The report, except the quality table and the sizes of the files."""
    args, adapted, adapter = run.args, result.adapted, result.adapter
    times, count, device = result.plan.seconds, launched().size, result.gaussians.means.device
    run.watch.seconds |= {
        "plan": times["bands"],
        "start": adapted.start_seconds,
        "train": adapted.seconds,
    }
    if run.cut:
        run.console.note(
            "the measurements were interrupted: only finished dial values are reported"
        )
    report = {
        "command": "adapt",
        "version": package_version(),
        "model": args.ply,
        "scene": args.images,
        "supervision": run.against,
        "screen_filter": asdict(result.gaussians.screen_filter),
        "base_count": adapter.base_count,
        "config": adapter.config,
        "attenuation": asdict(adapter.attenuation),
        "steps": adapted.steps,
        "interrupted": adapted.interrupted,
        "machine": machine(),
        "processes": {
            "count": count,
            "backend": BACKENDS[device.type] if count > 1 else None,
            "batch": run.config.batch,
        },
        "outputs": vars(run.outputs),
        "sh_degree": result.gaussians.sh_degree,
        "device": str(device),
        "seconds": run.watch.report(),
        "resumed_from": run.saver.state and run.saver.state.steps,
        "alignment": run.alignment,
        "notes": run.console.notes,
        "base_rows": [row.as_dict() for row in result.base_rows],
        "rows": [row.as_dict() for row in result.rows],
        "detached_row": result.plain[0].as_dict() if result.plain else None,
        "plan": result.plan.as_dict(),
        "forecast": against_forecast(run),
    }
    line, failed = ("", False) if report["interrupted"] else judge(run, result)
    failed = adapted.failed is not None or failed and not args.accept_loss
    return report | ({"loss": line} if line else {}) | ({"exit_code": 1} if failed else {})


def judge(run: Run, result: Result) -> tuple[str, bool]:
    """What is wrong with s = 1 and what to do, empty if nothing is; and whether the result has
    failed.
    """
    full = [row.psnr for row in result.rows if row.virtual_scale == 1]
    if not full or not result.base_rows:
        return "", False
    if run.against == "photographs":
        lost = result.base_rows[0].psnr - full[0]
        line = f"s = 1 is {lost:.2f} dB below the base on the held-out photographs"
        more = ""
        good, passed = (lost <= limit for limit in LOST)
    else:
        line = f"s = 1 has {full[0]:.2f} dB against the checkpoint's own renderings"
        more = ", or give the photographs (--images)"
        good, passed = (full[0] >= limit for limit in ENOUGH)
    advice = f"train longer (--iters){more}, or show s = 0, which is the base"
    return "" if good else f"{line}:\n{advice}", not passed


def print_summary(run: Run, result: Result) -> None:
    args, outputs = run.args, run.outputs
    if result.rows:
        marked = [("base", row) for row in result.base_rows] + by_dial(result.rows)
        print(f"\n{table(marked + [('plain', row) for row in result.plain])}\n")
        if result.plain:
            print(f"plain: {outputs.ply} in a viewer that does not know the dial\n")
    for path in vars(outputs).values():
        print(f"{size(path):>9}  {path}")
    print(f"\n{duration(run.watch.total())} in all; next:")
    model = shlex.quote(str(outputs.ply))
    images = [] if args.images is None else [f"--images {shlex.quote(args.images)}"]
    print("  clod-adapt view", model, f"--base {shlex.quote(args.ply)}", *images)
    if images:
        sv = " ".join(f"{s:g}" for s in sorted({1.0, run.config.max_sv}))
        print("  clod-adapt eval", model, *images, f"--sv {sv}")
