"""The plan as the user sees and overrules it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers.cpu import release_memory
from clod_adapter.training.plan import Decision, Override, Plan
from clod_adapter.training.planner import make_plan

from ..shared.console import Console
from .progress import ProgressDisplay
from .resume import BEGUN, Saver


def decide(
    args: argparse.Namespace,
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig,
    follower: ProgressDisplay,
    saver: Saver,
) -> Plan:
    """Makes the plan and prints it.

    Raises:
        ClodError: what is resumed was begun with another ``--with`` or ``--without``.
        KeyboardInterrupt: Ctrl-C while it was made.
    """
    _settle(args, saver)
    overrule = Override(frozenset(args.keep_in), frozenset(args.leave_out))
    plan = make_plan(base, scene, config, overrule, follower, resumed=saver.frozen)
    saver.belongs["frozen"] = plan.frozen
    follower.close()
    release_memory()  # of looking at all Gaussians, before those that are left are trained
    if args.trim and plan.trims(base):
        began = time.perf_counter()
        with follower.console.meter("what trimming changes") as meter:
            bound = plan.bound(base, scene, lambda done, total: meter.update(done / total, f"{done}/{total}"))
        seconds = plan.seconds | {"trim": time.perf_counter() - began}
        plan = replace(plan, decisions=(*plan.decisions, bound), seconds=seconds)
    show(plan.decisions, follower.console)
    if args.trim and plan.kept is not None and args.images is None:
        follower.console.say("  which no placed camera sees; others may: --with unseen keeps them")
    return plan


def _settle(args: argparse.Namespace, saver: Saver) -> None:
    """Has the state say by what it was overruled, and refuses one that was otherwise: its tensors are others."""
    asked = {"--with": sorted(args.keep_in), "--without": sorted(args.leave_out)}
    saver.belongs["overruled"] = asked
    then = saver.found.get("overruled", {}) if saver.state else asked
    if then != asked:
        words = " ".join(" ".join((option, *names)) for option, names in then.items() if names)
        raise ClodError(f"{saver.path}: is of a run with {words or 'no --with or --without'}; {BEGUN}")


def show(decisions: Sequence[Decision], console: Console) -> None:
    """One line each, aligned: what, what is done with it, by which number, and how to overrule that."""
    lines = [(d.what, d.verdict, d.measured, d.why, _option(d)) for d in decisions]
    widths = [max(map(len, column)) for column in zip(*(line[:3] for line in lines), strict=True)]
    widths.append(max((len(why) for *_, why, option in lines if option), default=0))  # others may reach further
    console.say("plan: what is done, by which number, and the option that overrules it")
    for what, verdict, number, why, option in lines:
        cells = (what.ljust(widths[0]), verdict.ljust(widths[1]), number.rjust(widths[2]), why.ljust(widths[3]), option)
        console.say(f"  {'  '.join(cells)}".rstrip())


def _option(decision: Decision) -> str:
    if not decision.name:
        return ""
    option = "--without" if decision.verdict in ("kept", "trained") else "--with"
    return f"{option} {decision.name}"
