"""``clod-adapt``: gives a checkpoint its dial, and writes the extended file, the adapter and a report."""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import asdict, replace
from typing import Any

from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.adapter_file import check_config
from clod_adapter.io.atomic import remove_leftovers
from clod_adapter.io.lock import output_lock
from clod_adapter.rasterizers.cpu import release_memory
from clod_adapter.training.loop import Adapted, Progress
from clod_adapter.training.plan import Plan
from clod_adapter.training.state import StateRefused

from ..commands.settings import make_config
from ..shared.alignment import require_alignment
from ..shared.antialiasing import with_filter
from ..shared.console import Console, duration
from ..shared.devices import on_device, pick_device
from ..shared.files import Outputs
from ..shared.inputs import place_scene, read_checkpoint, read_scene, with_pseudo_views
from ..shared.interrupts import GracefulStop
from ..shared.kernels import prepare_kernels
from ..shared.launch import launched
from ..shared.measure import measure
from ..shared.pages import AdaptPage
from ..shared.report import Stopwatch
from .blocks import Blocked
from .memory import image_cache, plan_memory, without_rows
from .plan import decide
from .processes import Job, together
from .progress import ProgressDisplay
from .result import Inputs, Outcome, Run, finish, hand_out
from .resume import Saver


def run(args: argparse.Namespace) -> dict[str, Any]:
    with output_lock(Outputs.of(args.ply, args.out).ply, shared=args.block is not None):
        return adapt(args)


def adapt(args: argparse.Namespace) -> dict[str, Any]:
    """What ``run`` does while no other run writes the same outputs."""
    now, config = begin(args)
    inputs = read_inputs(args, config, now.console, now.watch)
    now.memory = plan_memory(args, inputs.base, inputs.scene, now.console)
    now.blocked = Blocked.of(
        args, now.outputs, now.memory, inputs.base, inputs.scene, inputs.config, now.console, now.stop
    )
    gaussians, scene = inputs.base.gaussians, inputs.scene
    if now.blocked:
        inputs = replace(inputs, base=without_rows(inputs.base))
        if args.block:
            return now.blocked.alone(gaussians, scene, inputs.config)
    else:
        now.saver.belong(gaussians, scene, args.ply, args.images or "those placed for it")
    with now.watch.time("evaluate"):
        now.base_rows, notes = look_at_base(gaussians, scene, args, now.console)
    now.notes = [*inputs.notes, *notes]
    try:
        with now.stop.listening():  # until everything is written, so that one Ctrl-C loses nothing
            page = AdaptPage(gaussians, scene, inputs.config, now.console) if args.report else None
            outcome = learn_and_write(now, inputs, page)
        return finish(now, outcome, page)
    except StateRefused as error:
        raise now.saver.naming(error) from error
    except Exception:  # whatever it is, it ends the run: of what was learned nothing is lost
        now.saver.rescue()
        raise


def begin(args: argparse.Namespace) -> tuple[Run, AdaptConfig]:
    """A run and its settings, before anything is read."""
    console, stop = Console(args.quiet), GracefulStop(aborts=launched().size == 1)
    config, outputs = make_config(args), Outputs.of(args.ply, args.out)
    check_config(asdict(config))
    for path in vars(outputs).values():
        remove_leftovers(path)
    resume = args.resume and (not args.memory or outputs.state.exists())  # blocks have files of their own
    return Run(args, outputs, console, Stopwatch(), stop, Saver(outputs.state, resume, config, console, stop)), config


def read_inputs(args: argparse.Namespace, config: AdaptConfig, console: Console, watch: Stopwatch) -> Inputs:
    """Reads checkpoint and photographs, or places cameras.

    Raises:
        ClodError: something cannot be read, or checkpoint and photographs do not fit.
    """
    with watch.time("load"):
        base = on_device(read_checkpoint(args.ply, console, args.activated), pick_device(args.device, console))
        folder, cache = args.images, image_cache(args)
        photographs = read_scene(folder, console, base.origin, cache) if folder is not None else None
    with watch.time("kernels"):
        prepare_kernels(console, base.gaussians.means.device)
    with watch.time("evaluate"):
        views = [] if photographs is None else [*photographs.test, *photographs.train]
        base = with_filter(base, args, console, views)
    if base.gaussians.screen_filter.compensate:
        with watch.time("kernels"):
            prepare_kernels(console, base.gaussians.means.device, screen_filter=base.gaussians.screen_filter)
    if photographs is None:
        with watch.time("place"):
            return Inputs(base, place_scene(base.gaussians, config.seed, console), config, None, [])
    with watch.time("evaluate"):
        alignment, notes = require_alignment(base, photographs, args, console)
        scene, config = with_pseudo_views(base.gaussians, photographs, config, console)
    return Inputs(base, scene, config, alignment, notes)


def look_at_base(
    base: Gaussians, scene: Scene, args: argparse.Namespace, console: Console
) -> tuple[list[Row], list[str]]:
    """The base's row at dial 1, and notes: on a dial it has, on nothing held out."""
    notes = []
    if base.sigma_d is not None:
        notes.append(f"{args.ply} has a dial already: continuing from its sigma_d")
    rows: list[Row] = []
    if scene.test:
        rows, interrupted = measure(base, scene.test, [1.0], console, "base")
        if interrupted:
            raise KeyboardInterrupt
        if args.images is not None:  # of the checkpoint's own pictures only their rounding is worth knowing
            console.say(f"base: {rows[0].psnr:.2f} dB on the held-out photographs")
    else:
        notes.append("no photographs are held out, so nothing is measured; at least two are needed")
    for note in notes:
        console.say(note)
    return rows, notes


def learn_and_write(run: Run, inputs: Inputs, page: AdaptPage | None) -> Outcome:
    """Plans and trains, in blocks without a plan, which looks at all Gaussians at once; writes what came of it."""
    gaussians, scene, config, plan = inputs.base.gaussians, inputs.scene, inputs.config, None
    if run.blocked:
        adapted = run.blocked.all(gaussians, scene, config)
    else:
        base_row = run.base_rows[0] if run.base_rows else None
        follower = ProgressDisplay(run.console, run.stop, gaussians, scene.test, config.max_sv, base_row)
        plan = decide(run.args, gaussians, scene, config, follower, run.saver)
        adapted = train(gaussians, scene, plan, follower, run.saver, page)
    release_memory()  # of the training, before its outcome is copied and written
    return hand_out(run, inputs, plan, adapted)


def train(
    base: Gaussians, scene: Scene, plan: Plan, follower: ProgressDisplay, saver: Saver, page: AdaptPage | None = None
) -> Adapted:
    """Adapts as planned while the user watches. Raises KeyboardInterrupt when there is nothing worth writing."""
    console, watching = follower.console, page.watching(follower) if page else follower

    def whole(now: Progress) -> None:
        watching(replace(now, gaussians=lambda: plan.whole(base, now.gaussians())))

    with closing(follower), together(lambda: Job.of(plan, scene, saver.state), follower) as peers:
        adapted = plan.adapt(scene, saver.watching(whole), saver.state, peers)
    saver.keep()
    adapted = replace(
        adapted, gaussians=plan.whole(base, adapted.gaussians),
        start_seconds=adapted.start_seconds + plan.seconds["start"],
    )  # fmt: skip
    if follower.stop.aborted:
        raise KeyboardInterrupt
    how = "ended after" if adapted.failed else "interrupted after" if adapted.interrupted else "trained"
    console.say(f"{how} {adapted.steps} steps, {duration(adapted.seconds)}")
    return adapted
