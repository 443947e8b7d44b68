"""A run of ``clod-adapt`` before its training: the arguments, what is read, and the training
plan.
"""

import argparse
import math
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from clod_adapter import (
    Checkpoint,
    Decision,
    Gaussians,
    Override,
    Plan,
    Scene,
    Stopped,
    View,
    make_plan,
)
from clod_adapter._kernels.memory import release
from clod_adapter.adapter import dial_tensors
from clod_adapter.evaluation.calibrate import report_dials
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.evaluation.robustness import scene_fingerprint
from clod_adapter.progress import GracefulStop
from clod_adapter.training.loop import time_steps
from clod_adapter.training.plan import NOT_NEEDED
from clod_adapter.training.pseudo_views import with_pseudo_views

from ..shared import inputs
from ..shared.command import make_config
from ..shared.console import Console, ProgressDisplay, duration
from ..shared.measure import Stopwatch, measure
from ..shared.outputs import AdaptFiles, Report, size
from ..shared.process import launched
from .listeners import Saver

LONG = 100  # steps of a run that is worth a forecast
CHEAPER = 0.7  # measuring a dial value, of measuring the base
WRITING = 1e8  # bytes of a PLY per second, with everything that is written beside it


class Run:
    """The arguments, the services that all steps use, and what ``read`` and ``measure_base`` have
    found.

    Without photographs, or with too few, ``scene`` has pseudo views.
    """

    base: Checkpoint
    scene: Scene
    # the measurements of the check; None without photographs
    alignment: Report | None = None
    base_rows: list[Row]  # at dial value 1; none if nothing is held out
    base_seconds = 0.0  # of measuring it
    cut = True  # whether the measurements of the result are missing or incomplete
    forecast: Report | None = None
    forecast_at = 0.0

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.console, self.watch = args, Console(args.quiet), Stopwatch()
        self.stop = GracefulStop(aborts=launched().size == 1)  # launchers repeat signals
        self.config = make_config(args)
        self.against = "checkpoint" if args.images is None else "photographs"
        self.outputs = AdaptFiles.of(args.ply, args.out)
        self.saver = Saver(self.outputs.state, self.config, self.console, self.stop, args.resume)

    def read(self) -> None:
        """Reads checkpoint and photographs, or places cameras."""
        args = self.args
        console = self.console
        watch = self.watch
        views = list[View]()
        with watch.time("load"):
            device = inputs.pick_device(args.device, console)
            base = inputs.read_checkpoint(args.ply, console, args.activated, device=device)
            if base.vertex is not None:  # only writing needs the file's rows
                base = replace(base, vertex=mapped(base.vertex, self.outputs.ply.parent))
            photographs = (
                inputs.read_scene(args.images, console, base.origin) if args.images else None
            )
        with watch.time("kernels"):
            inputs.prepare_kernels(console, device)
        with watch.time("evaluate"):
            if photographs is not None:
                required = not args.misaligned_ok
                photographs, self.alignment = inputs.align_shown(
                    base, photographs, console, required=required
                )
                views = [*photographs.test, *photographs.train]
            self.base = base = inputs.with_filter(base, args, console, views)
        if base.gaussians.screen_filter.compensate:
            with watch.time("kernels"):
                inputs.prepare_kernels(console, device, screen_filter=base.gaussians.screen_filter)
        with (
            watch.time("place" if photographs is None else "evaluate"),
            closing(ProgressDisplay(console, self.stop)) as display,
        ):
            self.scene = with_pseudo_views(base.gaussians, photographs, self.config.seed, display)
        console.note(*self.scene.notes)
        self.config = self.config.for_views(len(self.scene.train))

    def identify(self) -> None:
        """Refuses the state of another run."""
        self.saver.identify(
            self.args.ply,
            self.args.images or "the pseudo views",
            # the Gaussians depend on the options for reading too
            base_sha256=f"{self.base.fingerprint}, {self.base.gaussians.screen_filter}",
            views_sha256=scene_fingerprint(self.scene),
            overruled={
                "--with": sorted(self.args.keep_in),
                "--without": sorted(self.args.leave_out),
            },
        )

    def measure_base(self) -> None:
        """Measures the base on the held-out views."""
        args, console, scene = self.args, self.console, self.scene
        if columns := tuple(dial_tensors(self.base.gaussians)):
            used = columns if self.config.growth == "on" else columns[:1]
            dropped = "; its growth_d is dropped, as growth is off" if used < columns else ""
            console.note(
                f"{args.ply} has a dial already: continuing from its {' and '.join(used)}{dropped}"
            )
        if not scene.test:
            console.note(
                "no photographs are held out, so nothing is measured; at least two are needed"
            )
        began = time.perf_counter()
        with self.watch.time("evaluate"), self.stop.listening():
            rows = measure(self.base.gaussians, scene.test, [1.0], console, self.stop, "base")
        if self.stop.requests:
            raise Stopped("stopped while the base was measured")
        if rows and args.images is not None:  # of pseudo views only the rounding is measured
            console.say(f"base: {rows[0].psnr:.2f} dB on the held-out photographs")
        self.base_rows, self.base_seconds = rows, time.perf_counter() - began


def decide(run: Run, display: ProgressDisplay) -> Plan:
    """Makes the plan, and prints it."""
    args, console, base = run.args, run.console, run.base.gaussians
    override = Override(frozenset(args.keep_in), frozenset(args.leave_out))
    plan = make_plan(base, run.scene, run.config, override, display)
    display.close()
    release()
    show_plan(plan.decisions, console)
    return plan


def forecast(run: Run, plan: Plan) -> None:
    """Estimates time and peak memory of the rest of a run in one process, without the page of
    ``--report``, from a few steps; not of a short run.
    """
    config = plan.config
    state = run.saver.state
    steps = config.steps - (state.steps if state else 0)
    if steps < LONG or launched().size > 1:
        return
    with run.console.status("timing a few steps ..."):
        each, fixed = time_steps(plan.start, run.scene, config, min(max(steps // 40, 16), 24))
    release()
    # a fiftieth more for saving the state
    training = fixed + min(1.02 * steps * each, config.time_budget or math.inf)
    dials = len(report_dials(config.max_sv)) + 1
    frame = run.base_rows[0].frame_ms / 1e3 if run.base_rows else 0.0
    measuring = CHEAPER * dials * (run.base_seconds + 15 * frame)
    peak = peak_bytes()
    seconds = training + measuring + _bytes(run.base.gaussians) / WRITING
    memory = f", {size(peak)}" if peak else ""
    run.console.say(f"forecast: {duration(seconds)}{memory} ({steps:,} steps)")
    run.forecast_at = time.perf_counter()
    run.forecast = {"seconds": round(seconds, 1), "bytes": peak, "steps": steps}


def against_forecast(run: Run) -> Report | None:
    """The forecast, and what the run has taken since."""
    taken = {
        "actual_seconds": round(time.perf_counter() - run.forecast_at, 1),
        "actual_bytes": peak_bytes(),
    }
    return run.forecast and run.forecast | taken


def peak_bytes() -> int:
    try:
        import resource
    except ImportError:  # Windows
        return 0  # not known
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )


def show_plan(decisions: Sequence[Decision], console: Console) -> None:
    needed = [each for each in decisions if each.verdict != NOT_NEEDED]
    width = max((len(each.what) for each in needed), default=0)
    console.say("plan: action, measured effect, option that overrides it; reasons in the report")
    for each in needed:
        what, verdict, name = each.what, each.verdict, each.name
        option = f"{'--without' if verdict == 'kept' else '--with'} {name}" if name else ""
        line = f"  {what:<{width}}  {verdict:<10}  {each.measured:>14}  {option}"
        console.say(line.rstrip())
    if others := [each.what for each in decisions if each.verdict == NOT_NEEDED]:
        console.say(f"  does not apply: {', '.join(others)}")


def _bytes(gaussians: Gaussians) -> int:
    return sum(4 * tensor.numel() for tensor in gaussians.tensors().values())


def mapped(array: np.ndarray, folder: Path) -> np.ndarray:
    """The array in a mapped file without a name in ``folder``; itself where four times its size are
    not free there.
    """
    try:
        if array.nbytes == 0 or shutil.disk_usage(folder).free < 4 * array.nbytes:
            return array
        with tempfile.TemporaryFile(dir=folder) as file:
            # not tofile, which loses the error of a full disk
            file.write(array.reshape(-1).view(np.uint8).data)
            file.flush()
            return np.asarray(np.memmap(file, array.dtype, "c", shape=array.shape))
    except OSError:
        return array
