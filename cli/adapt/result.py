"""What ``clod-adapt`` does with what was learned: writes it, measures it, and reports."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from clod_adapter.adapter import Adapter, detach, extract, trim
from clod_adapter.blocks.memory import MemoryPlan
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint, trimmed
from clod_adapter.training.loop import Adapted
from clod_adapter.training.plan import Plan
from clod_adapter.version import package_version

from ..shared.console import Console, duration
from ..shared.files import Outputs, size
from ..shared.interrupts import GracefulStop, listen_no_more
from ..shared.measure import measure
from ..shared.pages import AdaptPage
from ..shared.report import Stopwatch, machine, report_dials, table, write_report
from .blocks import Blocked
from .files import write, write_measured
from .memory import with_rows
from .processes import describe_processes, explain, hurried
from .resume import Saver


@dataclass(frozen=True)
class Inputs:
    """What is adapted, on what, and how.

    Attributes:
        scene, config: with company, and lighter, where there are few photographs.
        alignment: the numbers of the check against the photographs, for the report; None without photographs.
        notes: on how the two fit.
    """

    base: Checkpoint
    scene: Scene
    config: AdaptConfig
    alignment: dict[str, Any] | None
    notes: list[str]


@dataclass
class Run:
    """One run, as its steps share it.

    Attributes:
        memory, blocked: how ``--memory`` is spent, and the run in blocks, where the whole does not fit.
        base_rows: the base at dial 1; none where nothing is held out.
        notes: for the report.
    """

    args: argparse.Namespace
    outputs: Outputs
    console: Console
    watch: Stopwatch
    stop: GracefulStop
    saver: Saver
    memory: MemoryPlan | None = None
    blocked: Blocked | None = None
    base_rows: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Says it, here and in the report."""
        self.notes.append(text)
        self.console.say(text)


@dataclass(frozen=True)
class Outcome:
    """What was written.

    Attributes:
        inputs: their base with the rows and bands that the adapter has.
        report: what was known before anything was measured; is added to.
    """

    inputs: Inputs
    adapted: Adapted
    adapter: Adapter
    result: Gaussians
    report: dict[str, Any]


def hand_out(run: Run, inputs: Inputs, plan: Plan | None, adapted: Adapted) -> Outcome:
    """Writes the three files, not measured yet."""
    if hurried(adapted):
        listen_no_more()
    if plan:
        run.watch.seconds["plan"] = sum(plan.seconds.values()) - plan.seconds["start"]
    run.watch.seconds |= {"start": adapted.start_seconds, "train": adapted.seconds}
    gaussians = inputs.base.gaussians
    base, adapter = make_adapter(run, inputs, plan, adapted)
    if gaussians.sigma_d is None and adapter.attenuation.tau < inputs.config.tau:
        run.note(f"tau is {adapter.attenuation.tau:.2g} and not {inputs.config.tau:g}: the Gaussians are faint")
    if adapted.lost:
        run.note(f"training ended at step {adapted.steps}: {explain(adapted.lost)}")
    if adapted.failed:
        run.note(f"training ended early, and what was learned before is written: {adapted.failed}")
    if adapted.held:
        run.note(f"{adapted.held:,} Gaussians stayed where they were in some steps: their gradients were not finite")
    result = adapter.apply(gaussians)
    inputs = replace(inputs, base=with_rows(base, run.args) if run.blocked else base)
    report = describe_run(run, inputs, plan, adapted, adapter, result)
    with run.console.status(f"writing {run.outputs.ply} ..."):
        write(inputs.base, adapter, result, run.outputs, report)
    run.console.say(f"wrote {run.outputs.adapter} and {run.outputs.ply}")
    return Outcome(inputs, adapted, adapter, result, report)


def make_adapter(run: Run, inputs: Inputs, plan: Plan | None, adapted: Adapted) -> tuple[Checkpoint, Adapter]:
    """The adapter, and the checkpoint with the rows and bands that it has: with ``--trim`` without those left out."""
    gaussians, kept, degree = inputs.base.gaussians, None, None
    if plan and run.args.trim and plan.trims(gaussians):
        kept, degree = plan.kept, plan.sh_degree
    base = trimmed(inputs.base, kept, degree)
    adapter = extract(
        trim(gaussians, kept, degree), trim(adapted.gaussians, kept, degree), fingerprint=base.fingerprint,
        config=asdict(inputs.config), origin=base.origin,
    )  # fmt: skip
    return base, replace(adapter, kept=kept, sh_degree=degree)


def describe_run(
    run: Run, inputs: Inputs, plan: Plan | None, adapted: Adapted, adapter: Adapter, result: Gaussians
) -> dict[str, Any]:
    """The report before anything is measured."""
    args, state, config = run.args, run.saver.state, adapter.config
    return {
        "command": "adapt", "version": package_version(), "model": args.ply, "scene": args.images,
        "teacher": "checkpoint" if args.images is None else "photographs",
        "screen_filter": asdict(result.screen_filter),
        "base_count": adapter.base_count, "config": config, "attenuation": asdict(adapter.attenuation),
        "steps": adapted.steps, "interrupted": adapted.interrupted, "machine": machine(),
        "processes": describe_processes(adapted, config["batch"]), "outputs": run.outputs.names(),
        "sh_degree": result.sh_degree, "device": str(result.means.device), "seconds": run.watch.report(),
        "resumed_from": state and state.steps, "alignment": inputs.alignment,
        "notes": [*notes_of(run, inputs), "the result was not measured"],
        "base_rows": [row.as_dict() for row in run.base_rows], "rows": [], "detached_row": None,
        "plan": plan and plan.as_dict(), "memory": run.memory and asdict(run.memory),
    }  # fmt: skip


def notes_of(run: Run, inputs: Inputs) -> list[str]:
    """All that there are by now, for the report."""
    return [*inputs.base.notes, *inputs.scene.notes, *run.notes]


def finish(run: Run, outcome: Outcome, page: AdaptPage | None) -> dict[str, Any]:
    """Measures what was written, and writes it again with that; returns the report."""
    inputs, adapted, report = outcome.inputs, outcome.adapted, outcome.report
    skip = run.stop.requests > 0 and not adapted.interrupted or hurried(adapted)
    late = GracefulStop()
    with run.watch.time("evaluate"):
        measured = (outcome.result, inputs.scene, inputs.config, run.console)
        rows, plain, cut_short = ([], [], True) if skip else measure_result(*measured)
    if cut_short:
        run.note("the measurements were interrupted: only the dial values that were finished are reported")
    report |= {
        "rows": [row.as_dict() for row in rows], "detached_row": plain[0].as_dict() if plain else None,
        "notes": notes_of(run, inputs), "seconds": run.watch.report(),
    }  # fmt: skip
    if adapted.failed:
        report["exit_code"] = 1
    if rows and not cut_short:
        written = (inputs.base, outcome.adapter, outcome.result, rows, inputs.scene)
        write_measured(*written, run.outputs, report, run.console, late)
    else:
        write_report(run.outputs.report, report)
    run.saver.close(finished=not adapted.interrupted and not cut_short)
    if run.blocked and not cut_short:
        run.blocked.remove()
    if page and not cut_short and not late.requests:  # after the report, which no failure of the page is to cost
        add_page(run, outcome, page)
    print_summary(run.outputs, table(rows, run.base_rows, plain) if rows else "", run.args, run.watch)
    return report


def measure_result(
    result: Gaussians, scene: Scene, config: AdaptConfig, console: Console
) -> tuple[list[Row], list[Row], bool]:
    """The rows over the dial, the one without the dial at all, and whether Ctrl-C cut them short."""
    rows, cut_short = measure(result, scene.test, report_dials(config.max_sv), console)
    if cut_short:
        return rows, [], True
    plain, cut_short = measure(detach(result), scene.test, [1.0], console, "plain")
    return rows, plain, cut_short


def add_page(run: Run, outcome: Outcome, page: AdaptPage) -> None:
    """Writes the page, and the report again, which says where it is."""
    path, report = run.outputs.ply.with_suffix(".html"), outcome.report
    with run.watch.time("page"):
        written = page.write(path, report, outcome.result, outcome.adapted.start_seconds)
    report |= {"outputs": report["outputs"] | written, "seconds": run.watch.report()}
    write_report(run.outputs.report, report)


def print_summary(outputs: Outputs, measured: str, args: argparse.Namespace, watch: Stopwatch) -> None:
    if measured:
        print(f"\n{measured}\n")
        if "plain" in measured:
            print(f"plain: what a viewer that does not know the dial makes of {outputs.ply}\n")
    for path in vars(outputs).values():
        print(f"{size(path):>9}  {path}")
    following = "other dial values:" if args.images is not None else "against photographs, where there are any:"
    print(f"\n{duration(watch.total())} in all; next, {following}")
    sv = " ".join(f"{s:g}" for s in sorted({1.0, args.max_sv}))
    images = "DIR" if args.images is None else shlex.quote(args.images)
    print(f"  clod-adapt eval {shlex.quote(str(outputs.ply))} --images {images} --sv {sv}")
