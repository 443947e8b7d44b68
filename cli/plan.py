"""The plan as the user sees and overrules it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

from clod_adapter.cameras import Scene
from clod_adapter.cli.console import Console
from clod_adapter.cli.resume import Saver
from clod_adapter.cli.training import Follower
from clod_adapter.config import AdaptConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.plan import Decision, Overrule, Plan
from clod_adapter.planning import make_plan


def decide(
    args: argparse.Namespace, base: Gaussians, scene: Scene, config: AdaptConfig, follower: Follower, saver: Saver
) -> Plan:
    """Makes the plan and prints it.

    Raises:
        KeyboardInterrupt: Ctrl-C while it was made.
    """
    overrule = Overrule(frozenset(args.keep_in), frozenset(args.leave_out))
    plan = make_plan(base, scene, config, overrule, follower, resumed=saver.frozen)
    saver.belongs["frozen"] = plan.frozen
    follower.close()
    if args.trim and plan.trims(base):
        began = time.perf_counter()
        with follower.console.meter("what trimming changes") as meter:
            bound = plan.bound(base, scene, lambda done, total: meter.update(done / total, f"{done}/{total}"))
        seconds = plan.seconds | {"trim": time.perf_counter() - began}
        plan = replace(plan, decisions=(*plan.decisions, bound), seconds=seconds)
    show(plan.decisions, follower.console)
    return plan


def show(decisions: Sequence[Decision], console: Console) -> None:
    """One line each, aligned: what, what is done with it, by which number, and how to overrule that."""
    lines = [(d.what, d.verdict, d.measured, d.why, _option(d)) for d in decisions]
    if not lines:
        return
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    console.say("plan:")
    for what, verdict, number, why, option in lines:
        cells = (what.ljust(widths[0]), verdict.ljust(widths[1]), number.rjust(widths[2]), why.ljust(widths[3]), option)
        console.say(f"  {'  '.join(cells)}".rstrip())


def _option(decision: Decision) -> str:
    if not decision.name:
        return ""
    option = "--without" if decision.verdict in ("kept", "trained") else "--with"
    return f"{option} {decision.name}"
