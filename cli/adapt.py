"""``clod-adapt``: gives a checkpoint its dial, and writes the extended file, the adapter and a report."""

from __future__ import annotations

import argparse
import shlex
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from typing import Any

from clod_adapter.adapter import Adapter, detach, extract, trim
from clod_adapter.cameras import Scene
from clod_adapter.cli.alignment import require_alignment
from clod_adapter.cli.chunked import Chunked
from clod_adapter.cli.console import Console, duration
from clod_adapter.cli.devices import on_device, pick_device
from clod_adapter.cli.evaluate import measure
from clod_adapter.cli.files import Outputs, size
from clod_adapter.cli.inputs import complement_scene, place_scene, read_checkpoint, read_scene
from clod_adapter.cli.interrupts import GracefulStop
from clod_adapter.cli.kernels import prepare_kernels
from clod_adapter.cli.memory_plan import image_cache, plan_memory, with_rows, without_rows
from clod_adapter.cli.pages import AdaptPage
from clod_adapter.cli.plan import decide
from clod_adapter.cli.processes import Job, describe_processes, explain, hurried, together
from clod_adapter.cli.report import Stopwatch, machine, report_dials, table, write_report
from clod_adapter.cli.results import write, write_measured
from clod_adapter.cli.resume import Saver
from clod_adapter.cli.settings import make_config
from clod_adapter.cli.training import Follower
from clod_adapter.config import AdaptConfig
from clod_adapter.evaluate import Row
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.adapter_file import check_config
from clod_adapter.io.atomic import remove_leftovers
from clod_adapter.io.ply import Checkpoint
from clod_adapter.io.trimming import trimmed
from clod_adapter.io.version import package_version
from clod_adapter.plan import Plan
from clod_adapter.rasterizers.cpu import release_memory
from clod_adapter.train import Adapted, Progress


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


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch, stop = Console(args.quiet), Stopwatch(), GracefulStop()
    config, outputs = make_config(args), Outputs.of(args.ply, args.out)
    check_config(asdict(config))
    for path in vars(outputs).values():
        remove_leftovers(path)
    resume = args.resume and (not args.memory or outputs.state.exists())  # chunks have files of their own
    saver = Saver(outputs.state, resume, config, console, stop)
    inputs = read_inputs(args, config, console, watch)
    base, scene, config = inputs.base, inputs.scene, inputs.config
    memory = plan_memory(args, base, scene, console)
    chunked = Chunked.of(args, outputs, memory, base, scene, config, console, stop)
    if chunked:
        base = without_rows(base)
        inputs = replace(inputs, base=base)
    gaussians = base.gaussians
    if chunked and args.chunk:
        return chunked.alone(gaussians, scene, config)
    if not chunked:
        saver.belong(gaussians, scene, args.ply, args.images or "those placed for it")
    with watch.time("evaluate"):
        base_rows, notes = look_at_base(gaussians, scene, args, console)
    notes = [*inputs.notes, *notes]
    with stop.listening():  # until everything is written, so that one Ctrl-C loses nothing
        page = AdaptPage(gaussians, scene, config, console) if args.report else None
        follower = Follower(console, stop, gaussians, scene.test, config.max_sv, base_rows[0] if base_rows else None)
        plan, adapted = learn(args, gaussians, scene, config, chunked, follower, saver, page)
        if plan:
            watch.seconds["plan"] = sum(plan.seconds.values()) - plan.seconds["start"]
        watch.seconds |= {"start": adapted.start_seconds, "train": adapted.seconds}
        kept, degree = (plan.kept, plan.sh_degree) if plan and args.trim and plan.trims(gaussians) else (None, None)
        base = trimmed(base, kept, degree)
        adapter = extract(
            trim(gaussians, kept, degree), trim(adapted.gaussians, kept, degree), fingerprint=base.fingerprint,
            config=asdict(config), origin=base.origin,
        )  # fmt: skip
        adapter = replace(adapter, kept=kept, sh_degree=degree)
        if gaussians.sigma_d is None and adapter.attenuation.tau < config.tau:
            notes.append(f"tau is {adapter.attenuation.tau:.2g} and not {config.tau:g}: the Gaussians are faint")
            console.say(notes[-1])
        if adapted.lost:
            notes.append(f"training ended at step {adapted.steps}: {explain(adapted.lost)}")
            console.say(notes[-1])
        result = adapter.apply(gaussians)
        base = with_rows(base, args) if chunked else base
        report = describe_run(args, outputs, adapter, adapted) | {
            "sh_degree": result.sh_degree, "device": str(result.means.device), "seconds": watch.report(),
            "resumed_from": saver.state and saver.state.steps, "alignment": inputs.alignment,
            "notes": [*base.notes, *scene.notes, *notes, "the result was not measured"],
            "base_rows": [row.as_dict() for row in base_rows], "rows": [], "detached_row": None,
            "plan": plan and plan.as_dict(), "memory": memory and asdict(memory),
        }  # fmt: skip
        with console.status(f"writing {outputs.ply} ..."):
            write(base, adapter, result, outputs, report)
        console.say(f"wrote {outputs.adapter} and {outputs.ply}")
    skip = stop.requests > 0 and not adapted.interrupted or hurried(adapted)
    late = GracefulStop()
    with watch.time("evaluate"):
        rows, plain, cut_short = ([], [], True) if skip else measure_result(result, scene, config, console)
    if cut_short:
        notes.append("the measurements were interrupted: only the dial values that were finished are reported")
        console.say(notes[-1])
    report |= {
        "rows": [row.as_dict() for row in rows], "detached_row": plain[0].as_dict() if plain else None,
        "notes": [*base.notes, *scene.notes, *notes], "seconds": watch.report(),
    }  # fmt: skip
    if rows and not cut_short:
        write_measured(base, adapter, result, rows, scene, outputs, report, console, late)
    else:
        write_report(outputs.report, report)
    saver.close(finished=not adapted.interrupted and not cut_short)
    if chunked and not cut_short:
        chunked.remove()
    if page and not cut_short and not late.requests:  # after the report, which no failure of the page is to cost
        with watch.time("page"):
            written = page.write(outputs.ply.with_suffix(".html"), report, result, adapted.start_seconds)
        report |= {"outputs": report["outputs"] | written, "seconds": watch.report()}
        write_report(outputs.report, report)
    print_summary(outputs, table(rows, base_rows, plain) if rows else "", args, watch)
    return report


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
    if photographs is None:
        with watch.time("place"):
            return Inputs(base, place_scene(base.gaussians, config.seed, console), config, None, [])
    with watch.time("evaluate"):
        alignment, notes = require_alignment(base, photographs, args, console)
        scene, config = complement_scene(base.gaussians, photographs, config, console)
    return Inputs(base, scene, config, alignment, notes)


def describe_run(args: argparse.Namespace, outputs: Outputs, adapter: Adapter, adapted: Adapted) -> dict[str, Any]:
    """The part of the report that is known before anything is measured."""
    return {
        "command": "adapt", "version": package_version(), "model": args.ply, "scene": args.images,
        "teacher": "checkpoint" if args.images is None else "photographs",
        "base_count": adapter.base_count, "config": adapter.config, "attenuation": asdict(adapter.attenuation),
        "steps": adapted.steps, "interrupted": adapted.interrupted, "machine": machine(),
        "processes": describe_processes(adapted, adapter.config["batch"]), "outputs": outputs.names(),
    }  # fmt: skip


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


def learn(
    args: argparse.Namespace, gaussians: Gaussians, scene: Scene, config: AdaptConfig, chunked: Chunked | None,
    follower: Follower, saver: Saver, page: AdaptPage | None,
) -> tuple[Plan | None, Adapted]:  # fmt: skip
    """Plans and trains; in chunks without a plan, which looks at all Gaussians at once."""
    if chunked:
        plan, adapted = None, chunked.all(gaussians, scene, config)
    else:
        plan = decide(args, gaussians, scene, config, follower, saver)
        adapted = train(gaussians, scene, plan, follower, saver, page)
    release_memory()  # of the training, before its outcome is copied and written
    return plan, adapted


def train(
    base: Gaussians, scene: Scene, plan: Plan, follower: Follower, saver: Saver, page: AdaptPage | None = None
) -> Adapted:
    """Adapts as planned while the user watches. Raises KeyboardInterrupt when there is nothing worth writing."""
    console, watching = follower.console, page.watching(follower) if page else follower

    def whole(now: Progress) -> None:
        watching(replace(now, gaussians=lambda: plan.whole(base, now.gaussians())))

    with closing(follower), together(lambda: Job.of(plan, scene, saver.state), follower) as peers:
        adapted = plan.adapt(scene, saver.watching(whole), saver.state, peers)
    adapted = replace(
        adapted, gaussians=plan.whole(base, adapted.gaussians),
        start_seconds=adapted.start_seconds + plan.seconds["start"],
    )  # fmt: skip
    if follower.stop.requests > 1:
        raise KeyboardInterrupt
    how = "interrupted after" if adapted.interrupted else "trained"
    console.say(f"{how} {adapted.steps} steps, {duration(adapted.seconds)}")
    return adapted


def measure_result(
    result: Gaussians, scene: Scene, config: AdaptConfig, console: Console
) -> tuple[list[Row], list[Row], bool]:
    """The rows over the dial, the one without the dial at all, and whether Ctrl-C cut them short."""
    rows, cut_short = measure(result, scene.test, report_dials(config.max_sv), console)
    if cut_short:
        return rows, [], True
    plain, cut_short = measure(detach(result), scene.test, [1.0], console, "plain")
    return rows, plain, cut_short


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
