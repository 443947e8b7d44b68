"""The second value of the pipeline: checkpoint and scene, and their measurements before training."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from clod_adapter.adapter import dial_tensors
from clod_adapter.blocks.memory import MemoryPlan
from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.progress import Stopped

from ..shared.alignment import align
from ..shared.inputs import (
    on_device,
    pick_device,
    place_scene,
    prepare_kernels,
    read_checkpoint,
    read_scene,
    with_filter,
    with_pseudo_views,
)
from ..shared.measure import measure
from .memory import image_cache, plan_memory, rows_on_disk, without_rows
from .setup import Setup


@dataclass(frozen=True)
class Inputs:
    """What is adapted, on which views, and how.

    Attributes:
        scene, config: without photographs or with too few, with pseudo views and lower learning rates.
        alignment: the measurements of the alignment check, for the report; None without photographs.
        memory: the plan for ``--memory``; None without the option.
        notes: for the report.
        base_rows: the base at dial value 1; empty if nothing is held out.
    """

    base: Checkpoint
    scene: Scene
    config: AdaptConfig
    alignment: dict[str, Any] | None
    memory: MemoryPlan | None
    notes: tuple[str, ...] = ()
    base_rows: tuple[Row, ...] = ()


def read_inputs(setup: Setup) -> Inputs:
    """Reads checkpoint and photographs, or places cameras.

    Raises:
        ClodError: something cannot be read, checkpoint and photographs do not fit, or memory is too small.
    """
    args, console, watch = setup.args, setup.console, setup.watch
    with watch.time("load"):
        base = on_device(read_checkpoint(args.ply, console, args.activated), pick_device(args.device, console))
        base = without_rows(base) if args.block else rows_on_disk(base, setup.outputs.ply.parent)
        photographs = read_scene(args.images, console, base.origin, image_cache(args)) if args.images else None
    with watch.time("kernels"):
        prepare_kernels(console, base.gaussians.means.device)
    config, alignment, views = setup.config, None, list[View]()
    with watch.time("evaluate"):
        if photographs is not None:
            photographs, alignment = align(base, photographs, args.images, console, required=not args.misaligned_ok)
            views = [*photographs.test, *photographs.train]
        base = with_filter(base, args, console, views)
    if base.gaussians.screen_filter.compensate:
        with watch.time("kernels"):
            prepare_kernels(console, base.gaussians.means.device, screen_filter=base.gaussians.screen_filter)
    if photographs is None:
        with watch.time("place"):
            scene, config = place_scene(base.gaussians, config, console)
    else:
        with watch.time("evaluate"):
            scene, config = with_pseudo_views(base.gaussians, photographs, config, console)
    return Inputs(base, scene, config, alignment, plan_memory(args, base, scene, console))


def with_base_rows(setup: Setup, inputs: Inputs) -> Inputs:
    """The inputs with the base measured on the held-out views.

    Raises:
        Stopped: Ctrl-C.
    """
    args, console, scene, notes = setup.args, setup.console, inputs.scene, list[str]()
    if columns := tuple(dial_tensors(inputs.base.gaussians)):
        used = columns if inputs.config.growth == "on" else columns[:1]
        dropped = "; its growth_d is dropped, as growth is off" if used < columns else ""
        notes.append(f"{args.ply} has a dial already: continuing from its {' and '.join(used)}{dropped}")
    if not scene.test:
        notes.append("no photographs are held out, so nothing is measured; at least two are needed")
    with setup.watch.time("evaluate"):
        rows, interrupted = measure(inputs.base.gaussians, scene.test, [1.0], console, "base")
    if interrupted:
        raise Stopped("stopped while the base was measured")
    if rows and args.images is not None:  # of pseudo views only the rounding is measured
        console.say(f"base: {rows[0].psnr:.2f} dB on the held-out photographs")
    for note in notes:
        console.say(note)
    return replace(inputs, base_rows=tuple(rows), notes=(*inputs.notes, *notes))
