"""``clod-adapt``: gives a checkpoint its dial, and writes the extended file, the adapter and a report.

A pipeline of values: ``Setup -> Inputs -> Plan -> Result -> report``.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import replace
from typing import Any

from clod_adapter.progress import Progress
from clod_adapter.rasterizers.frame import release_memory
from clod_adapter.training.plan import Plan
from clod_adapter.training.state import Adapted

from ..shared.console import duration
from ..shared.pages import AdaptPage
from .block_job import run_job
from .blocks import Blocks
from .display import ProgressDisplay
from .inputs import Inputs, read_inputs, with_base_rows
from .memory import move_to_disk
from .plan import decide
from .processes import TrainingJob, together
from .report import finish
from .result import make_result
from .resume import identify
from .saver import Saver
from .setup import Setup


def run(args: argparse.Namespace) -> dict[str, Any]:
    setup = Setup.of(args)
    inputs = read_inputs(setup)
    blocks = Blocks.of(setup, inputs)
    if blocks is None:
        return adapt_whole(setup, inputs)
    return run_job(blocks, inputs) if args.block else adapt_blocks(setup, inputs, blocks)


def adapt_whole(setup: Setup, inputs: Inputs) -> dict[str, Any]:
    """Plans, trains, writes and reports."""
    run_of = identify(setup.resumed, inputs.base.gaussians, inputs.scene, setup.config, setup.args, setup.console)
    inputs = with_base_rows(setup, inputs)
    with setup.stop.listening():  # until training has ended, so that a Ctrl-C loses nothing
        display = show_progress(setup, inputs)
        plan = decide(setup, inputs, display)
        if plan.kept is not None:  # what is trained is a copy
            move_to_disk(inputs.base.gaussians, setup.outputs.ply.parent)
        page = make_page(setup, inputs)
        saver = Saver(setup.outputs.state, run_of, setup.resumed, setup.console, setup.stop)
        with saver.rescuing():
            adapted = train(setup, inputs, plan, display, saver, page)
            result = make_result(setup, inputs, plan, adapted)
    with saver.rescuing():
        return finish(setup, inputs, result, page, saver.close)


def adapt_blocks(setup: Setup, inputs: Inputs, blocks: Blocks) -> dict[str, Any]:
    """The same in blocks."""
    inputs = with_base_rows(setup, inputs)
    with setup.stop.listening():
        page = make_page(setup, inputs)
        plan, adapted = blocks.adapt(inputs)
        release_memory()
        result = make_result(setup, inputs, plan, adapted)
    return finish(setup, inputs, result, page, lambda complete: blocks.remove() if complete else None)


def show_progress(setup: Setup, inputs: Inputs) -> ProgressDisplay:
    base = inputs.base.gaussians if setup.args.images is not None else None
    row = inputs.base_rows[0] if inputs.base_rows else None
    return ProgressDisplay(setup.console, setup.stop, base, inputs.scene.test, row)


def make_page(setup: Setup, inputs: Inputs) -> AdaptPage | None:
    if not setup.args.report:
        return None
    return AdaptPage(inputs.base.gaussians, inputs.scene, inputs.config, setup.console)


def train(
    setup: Setup, inputs: Inputs, plan: Plan, display: ProgressDisplay, saver: Saver, page: AdaptPage | None
) -> Adapted:
    """Trains as planned; returns the result for all Gaussians.

    Raises:
        ClodError: the state to resume from does not fit.
        KeyboardInterrupt: a second Ctrl-C.
    """
    base, console, scene = inputs.base.gaussians, setup.console, inputs.scene
    state = setup.resumed.state if setup.resumed else None

    def show(now: Progress) -> bool:
        part = now.gaussians
        now = replace(now, gaussians=lambda: plan.whole(base, part())) if part else now
        if page:
            page(now)
        return display(now)

    with closing(display), together(lambda: TrainingJob.of(plan, scene, state), display) as group:
        adapted = plan.adapt(scene, saver.saving(show), state, group)
    saver.keep()
    adapted = replace(
        adapted, gaussians=plan.whole(base, adapted.gaussians),
        start_seconds=adapted.start_seconds + plan.seconds["start"],
    )  # fmt: skip
    how = "ended after" if adapted.failed else "interrupted after" if adapted.interrupted else "trained"
    console.say(f"{how} {adapted.steps} steps, {duration(adapted.seconds)}")
    release_memory()
    return adapted
