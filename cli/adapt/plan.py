"""Making and printing the plan."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

from clod_adapter.progress import Phase
from clod_adapter.rasterizers.frame import release_memory
from clod_adapter.training.plan import NOT_NEEDED, Decision, Override, Plan
from clod_adapter.training.planner import make_plan

from ..shared.console import Console
from .display import ProgressDisplay
from .inputs import Inputs
from .setup import Setup


def decide(setup: Setup, inputs: Inputs, display: ProgressDisplay) -> Plan:
    """Makes the plan and prints it.

    Raises:
        Stopped: Ctrl-C.
    """
    plan = make_plan(inputs.base.gaussians, inputs.scene, inputs.config, override(setup.args), display)
    display.close()
    release_memory()  # of looking at all Gaussians, before only those that are kept are trained
    return complete(plan, setup, inputs)


def override(args: argparse.Namespace) -> Override:
    """Of ``--with`` and ``--without``."""
    return Override(frozenset(args.keep_in), frozenset(args.leave_out))


def complete(plan: Plan, setup: Setup, inputs: Inputs) -> Plan:
    """The plan, which is printed, with the effect of ``--trim``."""
    args, base = setup.args, inputs.base.gaussians
    if args.trim and plan.trims(base):
        plan = _with_trimming_effect(plan, inputs, setup.console)
    show_plan(plan.decisions, setup.console)
    if args.trim and plan.kept is not None and args.images is None:
        setup.console.say("  no placed camera sees them, but other cameras may: --with unseen keeps them")
    return plan


def _with_trimming_effect(plan: Plan, inputs: Inputs, console: Console) -> Plan:
    began = time.perf_counter()
    with console.meter(Phase.TRIMMING) as meter:
        effect = plan.trimming_effect(inputs.base.gaussians, inputs.scene, meter)
    seconds = plan.seconds | {"trim": time.perf_counter() - began}
    return replace(plan, decisions=(*plan.decisions, effect), seconds=seconds)


def show_plan(decisions: Sequence[Decision], console: Console) -> None:
    """One aligned line per decision, and one line with the names of what this scene does not need."""
    made = [decision for decision in decisions if decision.verdict != NOT_NEEDED]
    rows = [(decision.what, decision.verdict, decision.measured) for decision in made]
    a, b, c = (max(map(len, column)) for column in zip(*rows, strict=True)) if rows else (0, 0, 0)
    console.say("plan: action, measured effect, option that overrides it; reasons in the report")
    for decision, (what, verdict, effect) in zip(made, rows, strict=True):
        console.say(f"  {what:<{a}}  {verdict:<{b}}  {effect:>{c}}  {_option(decision)}".rstrip())
    if others := [decision.what for decision in decisions if decision.verdict == NOT_NEEDED]:
        console.say(f"  does not apply: {', '.join(others)}")


def _option(decision: Decision) -> str:
    if not decision.name:
        return ""
    option = "--without" if decision.verdict == "kept" else "--with"
    return f"{option} {decision.name}"
