"""``clod-adapt export``: writes a model in another format, with its dial or with one dial value baked in."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from clod_adapter._support.version import package_version
from clod_adapter.bake import order_by_extinction
from clod_adapter.cameras import Camera
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path, atomic_paths
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.ply.columns import MASKS, dial_columns, inria_dtype
from clod_adapter.io.ply.constants import PREFIX
from clod_adapter.io.scene.load import load_cameras

from ..commands.export_formats import LOD_META, PAGE, TILESET, level_paths, suffix_of
from ..shared.command import given_budget, initial_dial
from ..shared.console import Console, put
from ..shared.inputs import on_device, pick_device, read_checkpoint, with_filter
from ..shared.measure import Stopwatch, choose_dials, solve_dials
from ..shared.outputs import size
from .baking import Photographs, Target, find_target, measure_drop
from .files import Export

CALIBRATED_DIAL = (
    "--psnr-drop uses the calibration, which measured the dial and not the file: at equal counts, files of three "
    "captures were at most 0.05 dB below it; with --images the file itself is measured"
)
STORE_FILTER = (".spz", ".safetensors", PAGE)  # formats in which every reader finds the screen-space filter


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch, page = Console(args.quiet), Stopwatch(), Path(args.out).suffix.lower() == PAGE
    model = with_filter(read_checkpoint(args.model, console, args.activated), args, console)
    if args.images is not None and (args.fps or args.psnr_drop):  # frames are timed, or files measured
        model = on_device(model, pick_device(args.device, console))
    export, notes = prepare_export(args, model, page, console)
    dials, photographs, more = dial_values(args, export, page, console)
    notes += [*more, *dropped_columns(model), *filter_notes(args, export.gaussians, dials)]
    for note in notes:
        console.say(note)
    outputs, losses = write_export(args, export, dials)
    if photographs:
        losses += add_psnr(outputs[0], export, photographs, args.psnr_drop[0])
    losses = list(dict.fromkeys(losses))
    for note in losses:
        console.note(note)
    put("\n".join(output_line(output, len(export.gaussians)) for output in outputs))
    if dials is not None and not page:
        put(baking_line(export.target, model.gaussians.growth_d is not None))
    camera = export.target.camera
    return {
        "command": "export", "version": package_version(), "model": args.model, "base_count": len(export.gaussians),
        "camera": camera.name if camera else None, "cameras": len(export.target.cameras), "order": args.order,
        "outputs": outputs, "notes": [*model.notes, *notes, *losses], "seconds": watch.report(),
    }  # fmt: skip


def prepare_export(
    args: argparse.Namespace, model: Checkpoint, page: bool, console: Console
) -> tuple[Export, list[str]]:
    """The model sorted as asked for, with the cameras to bake for; and notes on these."""
    target, cameras, notes = Target(None, (), ""), list[Camera](), list[str]()
    baked = args.levels or args.sv or given_budget(args)
    if args.order or (baked and not (page and (args.sv or args.psnr_drop))):
        target, notes = find_target(args, model, console)
    if page and args.images is not None:
        cameras, notes = load_cameras(args.images, model.origin)
    gaussians = model.gaussians
    if args.order:
        gaussians = gaussians.select(order_by_extinction(gaussians, target.cameras))
    return Export(model, gaussians, target, cameras, bool(args.order), args.exact, console), notes


def dial_values(
    args: argparse.Namespace, export: Export, page: bool, console: Console
) -> tuple[list[float] | None, Photographs | None, list[str]]:
    """The dial values to bake, the initial one for a page, or None to keep the dial; and notes on them.

    The second value has the photographs to measure the file on, where --psnr-drop asks for it.
    """
    model, target = export.model, export.target
    attenuation = model.gaussians.attenuation
    if args.psnr_drop and args.images is not None and target.camera is None and not page:
        found, photographs = measure_drop(args, model, partial(export.candidate, Path(args.out)), console)
        return [found], photographs, []
    solved, notes = args.levels, list[str]()
    if solved is None:
        solved, notes = solve_dials(args, model, target.cameras, console, baked=target.camera is None and not page)
    if solved is None:
        return None, None, notes
    if page and attenuation is not None:
        opening, more = initial_dial(solved[0], attenuation.max_sv)
        return [opening], None, notes + more
    if args.psnr_drop and target.camera is None:
        notes.append(CALIBRATED_DIAL)
    dials, beyond = choose_dials(solved, attenuation)
    return dials, None, notes + beyond


def dropped_columns(model: Checkpoint) -> list[str]:
    """A note on columns of the model that outputs do not have."""
    names = model.vertex.dtype.names or ()
    known = {*(inria_dtype(model.gaussians.sh_degree, dial=dial_columns(names)).names or ()), *MASKS}
    others = [name for name in names if name not in known and not name.startswith(PREFIX)]  # the prefix marks settings
    return [f"columns dropped: {', '.join(others)}"] if others else []


def filter_notes(args: argparse.Namespace, gaussians: Gaussians, dials: list[float] | None) -> list[str]:
    """A note on an antialiasing filter that readers of the output do not find in the file."""
    suffix = LOD_META if args.lod_meta else ".glb" if args.tiles else suffix_of(Path(args.out))
    dialled = gaussians.sigma_d is not None and dials is None
    if not gaussians.screen_filter.compensate or dialled or suffix in STORE_FILTER:
        return []
    options = 'antiAlias in PlayCanvas, rasterize_mode="antialiased" in gsplat'
    return [
        f"trained antialiased ({gaussians.screen_filter.description}): most readers need an option for it: {options}"
    ]


def write_export(
    args: argparse.Namespace, export: Export, dials: list[float] | None
) -> tuple[list[dict[str, Any]], list[str]]:
    """Writes all files of the command; a description of each, and notes."""
    out = Path(args.out)
    if args.lod_meta or args.tiles:
        return write_set(export, out, dials, LOD_META if args.lod_meta else TILESET)
    return write_files(export, level_paths(out, args.levels) if args.levels else [out], dials)


def write_files(export: Export, paths: list[Path], dials: list[float] | None) -> tuple[list[dict[str, Any]], list[str]]:
    """Writes one file, or one per dial value, all or none; a description of each, and notes."""
    outputs, notes = list[dict[str, Any]](), list[str]()
    chosen: list[float | None] = [None] if dials is None else [*dials]
    with atomic_paths(*paths) as temporaries:
        for path, temporary, dial in zip(paths, temporaries, chosen, strict=True):
            count, more = export.write(temporary, suffix_of(path), dial)
            taken = temporary.stat().st_size
            outputs.append({"file": str(path), "virtual_scale": dial, "count": count, "bytes": taken})
            notes += more
    return outputs, notes


def write_set(
    export: Export, out: Path, dials: list[float] | None, index: str
) -> tuple[list[dict[str, Any]], list[str]]:
    """Writes a streaming set with this index; a description of it, and notes."""
    assert dials is not None  # checked by check_export
    with atomic_path(out) as folder:
        counts, notes = (export.write_levels if index == LOD_META else export.write_tiles)(folder, dials)
        total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    levels = [{"virtual_scale": dial, "count": count} for dial, count in zip(dials, counts, strict=True)]
    return [{"file": str(out / index), "levels": levels, "count": sum(counts), "bytes": total}], list(notes)


def add_psnr(output: dict[str, Any], export: Export, photographs: Photographs, drop: float) -> list[str]:
    """Measures the written file and adds the PSNR to its description; a note where it lost more than ``drop`` dB."""
    path = Path(output["file"])
    lost = photographs.drop_of(export.read_back(path, suffix_of(path)), export.console, path.name)
    reference = photographs.reference
    output |= {"psnr": reference - lost, "reference_psnr": reference, "views": len(photographs.views)}
    return (
        [f"{path} is {lost:.2f} dB below the model, not {drop:g}: splat-transform rounds values"] if lost > drop else []
    )


def output_line(output: dict[str, Any], total: int) -> str:
    """One line on an output of a model of ``total`` Gaussians."""
    line = f"wrote {output['file']} ({size(output['bytes'])}): {output['count']:,}"
    if levels := output.get("levels"):
        shown = ", ".join(f"{level['count']:,} at s = {level['virtual_scale']:.5g}" for level in levels)
        return f"{line} Gaussians in {len(levels)} levels, {shown}"
    if output["virtual_scale"] is None:
        return f"{line} Gaussians"
    if output["file"].lower().endswith(PAGE):
        return f"{line} Gaussians, initial dial value s = {output['virtual_scale']:.5g}"
    line = f"{line} of {total:,} Gaussians, s = {output['virtual_scale']:.5g}"
    if "psnr" not in output:
        return line
    lost = output["reference_psnr"] - output["psnr"]
    below = f"{lost:.2f} below" if lost > 0 else f"{-lost:.2f} above"
    return f"{line}; {output['psnr']:.2f} dB on {output['views']} held-out photographs, {below} the model at s = 1"


def baking_line(target: Target, growth: bool) -> str:
    """The cameras that a baked file is for, and what it lacks."""
    cameras = f"exact at the camera of {target.camera.name} only" if target.camera else f"baked for {target.about}"
    scales = "; the scales include growth" if growth else ""
    return f"{cameras}; lossy: without the dial and the Gaussians culled at this dial value{scales}"
