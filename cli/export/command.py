"""``clod-adapt export``: writes a model in another format, with its dial or with one dial value baked in."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clod_adapter._support.version import package_version
from clod_adapter.errors import ClodError
from clod_adapter.io.formats.splat_transform import SplatTransform

from ..shared.command import (
    Command,
    add_activated,
    add_antialiasing,
    add_device,
    add_dial_options,
    check_checkpoint,
    check_dials,
    check_scene,
    given_budget,
    initial_dial,
    model_has_dial,
)  # fmt: skip
from ..shared.console import Console, put
from ..shared.outputs import Outputs, size
from .formats import FORMATS, LOD_META, PACKED, PAGE, STORE_FILTER, TILESET, format_table, level_paths, suffix_of

if TYPE_CHECKING:
    from clod_adapter.io.checkpoint import Checkpoint

    from .files import Export, Target

DIGITS = 6  # significant digits of a level, all of them in its file's name


def levels_of(text: str) -> list[float]:
    """Parses ``1,2,4,7``."""
    try:
        levels = [float(f"{float(word):.{DIGITS}g}") for word in text.split(",")]
    except ValueError:
        levels = []
    if not levels or levels[0] < 0 or not all(a < b for a, b in pairwise([*levels, inf])):
        raise ArgumentTypeError(f"{text!r} must be ascending dial values of at least 0, as in 1,2,4,7")
    return levels


def add_arguments(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    given.add_argument("model", metavar="MODEL", help="an adapted file, or a plain one to convert")
    given.add_argument("--images", metavar="DIR", help="scene folder: cameras to bake for, and for the views of a page")
    given.add_argument(
        "--camera", metavar="PHOTO", help="bake for the camera of this photograph alone; its suffix can be left out"
    )
    add_activated(given)
    add_antialiasing(given, photographs=False)
    dial = parser.add_argument_group("dial values, one of")
    add_dial_options(dial, "the dial value to bake", "(in the file written)", several=False)
    dial.add_argument(
        "--levels", metavar="S,S,...", type=levels_of, help="several dial values, each baked into its own file"
    )
    output = parser.add_argument_group("output")
    output.add_argument("-o", "--out", metavar="OUT", required=True, help="output file; its suffix is the format")
    output.add_argument(
        "--lod-meta", action="store_true",
        help="write the levels as one streaming set for PlayCanvas's viewers, in the new folder OUT",
    )  # fmt: skip
    output.add_argument(
        "--3dtiles", dest="tiles", action="store_true",
        help="write the levels as one 3D Tiles set, for CesiumJS, in the new folder OUT",
    )  # fmt: skip
    output.add_argument(
        "--order", choices=["extinction"],
        help="sort the Gaussians by the dial value at which they are culled, latest first, for prefix rendering",
    )  # fmt: skip
    output.add_argument(
        "--exact", action="store_true",
        help="store float32 values in an .html page, in place of rounded ones: eight times the size",
    )  # fmt: skip
    add_device(output, "time frames for --fps with --images")


def check(args: Namespace) -> None:
    bakes = bool(args.levels) or args.sv is not None or given_budget(args) is not None
    check_together(args, bakes)
    if args.images is not None:
        check_scene(args.images)
    check_out(args)
    check_dials(args, args.model, measured=("fps",) if args.images is not None else ())
    check_checkpoint(args.model)
    dial, folder = model_has_dial(args.model), folder_option(args)
    if bakes and not dial:
        raise ClodError(f"{args.model}: has no sigma_d, so no dial value can be baked; export it without one")
    if args.order and not dial:
        raise ClodError(f"{args.model}: has no sigma_d to order its Gaussians by; adapt it first")
    suffix = "" if folder else suffix_of(Path(args.out))
    if dial and not bakes and suffix and not FORMATS[suffix].sigma:
        others = ", ".join(other for other, form in FORMATS.items() if form.sigma)
        raise ClodError(
            f"{args.out}: {suffix} cannot store a dial; choose a dial value to bake, as in --sv 1, or another format "
            f"({others})"
        )
    if args.order and suffix and not FORMATS[suffix].ordered:
        raise ClodError(f"{args.out}: {suffix} sorts the Gaussians itself; remove --order")
    if args.lod_meta or suffix in PACKED:
        SplatTransform.find()


def check_together(args: Namespace, bakes: bool) -> None:
    """Refuses options that do not go together."""
    page, folder = is_page(args), folder_option(args)
    refused = (
        (args.levels and (args.sv is not None or given_budget(args) is not None),
         "--levels gives the dial values; give no other option for them"),
        (args.lod_meta and args.tiles, "--lod-meta and --3dtiles write a folder each; give one of them"),
        (folder and not (args.levels and len(args.levels) > 1),
         f"{folder} needs several levels; give them, as in --levels 1,2,4,7"),
        (folder and args.order, f"{folder} sorts the Gaussians itself; remove --order"),
        (args.camera is not None and args.images is None,
         "--camera needs the scene of the photograph; give --images too"),
        (page and (args.levels or args.camera is not None or args.order),
         f"a {PAGE} page contains the whole dial; remove --levels, --camera and --order"),
        (args.camera is not None and not bakes, "--camera needs a dial value to bake; give one, as in --sv 2"),
        (args.exact and not page, f"--exact is for {PAGE} pages; another format has its own precision: remove it"),
        (args.images is not None and not (bakes or args.order or page),
         f"--images is used for baking, --order and {PAGE} only; add one of them, as in --sv 2"),
    )  # fmt: skip
    for wrong, why in refused:
        if wrong:
            raise ClodError(why)


def check_out(args: Namespace) -> None:
    """Refuses an OUT whose suffix is no format, or that cannot be a folder."""
    out, option = Path(args.out), folder_option(args)
    if option is None:
        suffix_of(out)
    elif out.suffix.lower() in (".json", *FORMATS):
        index = LOD_META if args.lod_meta else TILESET
        raise ClodError(f"{out}: with {option}, --out names the folder for {index}, not a file")
    elif out.exists() and not out.is_dir():
        raise ClodError(f"{out}: is a file; with {option}, --out must name a new folder")
    elif not out.name:  # ".", the current folder, which cannot be replaced
        raise ClodError(f"{out}: is the current folder; --out must name a new one")


def folder_option(args: Namespace) -> str | None:
    """The option with which OUT is a folder of levels."""
    return "--lod-meta" if args.lod_meta else "--3dtiles" if args.tiles else None


def is_page(args: Namespace) -> bool:
    return Path(args.out).suffix.lower() == PAGE


def outputs(args: Namespace) -> Outputs:
    out, folder = Path(args.out), folder_option(args) is not None
    levels = level_paths(out, args.levels) if args.levels and not folder else []
    return Outputs([] if levels else [out], levels, whole=folder, inputs=[args.model], scene=args.images)


def run(args: Namespace) -> dict[str, Any]:
    from ..shared.inputs import on_device, pick_device, read_checkpoint, with_filter
    from ..shared.measure import Stopwatch

    console, watch = Console(args.quiet), Stopwatch()
    model = with_filter(read_checkpoint(args.model, console, args.activated), args, console)
    if args.images is not None and args.fps:
        model = on_device(model, pick_device(args.device, console))
    export, notes = prepare(args, model, console)
    dials, more = dial_values(args, export, console)
    notes += [*more, *dropped_columns(model), *filter_notes(args, export, dials)]
    for note in notes:
        console.say(note)
    written, losses = write(args, export, dials)
    losses = list(dict.fromkeys(losses))
    for note in losses:
        console.note(note)
    put("\n".join(output_line(output, len(export.gaussians)) for output in written))
    if dials is not None and not is_page(args):
        put(baking_line(export.target, model.gaussians.growth_d is not None))
    camera = export.target.camera
    return {
        "command": "export", "version": package_version(), "model": args.model, "base_count": len(export.gaussians),
        "camera": camera.name if camera else None, "cameras": len(export.target.cameras), "order": args.order,
        "outputs": written, "notes": [*model.notes, *notes, *losses], "seconds": watch.report(),
    }  # fmt: skip


def prepare(args: Namespace, model: Checkpoint, console: Console) -> tuple[Export, list[str]]:
    """The model sorted as asked for, with the cameras to bake for; and notes on these."""
    from clod_adapter.bake import order_by_extinction
    from clod_adapter.io.scene.load import load_cameras

    from .files import Export, Target, find_target

    page, target, cameras, notes = is_page(args), Target(None, (), ""), list[Any](), list[str]()
    if args.order or args.levels or (args.sv and not page) or (given_budget(args) and not (page and args.psnr_drop)):
        target, notes = find_target(args, model, console)
    if page and args.images is not None:
        cameras, notes = load_cameras(args.images, model.origin)
    gaussians = model.gaussians
    if args.order:
        gaussians = gaussians.select(order_by_extinction(gaussians, target.cameras))
    return Export(model, gaussians, target, cameras, bool(args.order), args.exact, console), notes


def dial_values(args: Namespace, export: Export, console: Console) -> tuple[list[float] | None, list[str]]:
    """The dial values to bake, the initial one for a page, or None to keep the dial; and notes on them."""
    from ..shared.measure import choose_dials, solve_dials

    target, page, attenuation = export.target, is_page(args), export.model.gaussians.attenuation
    solved, notes = args.levels, list[str]()
    if solved is None:
        baked = target.camera is None and not page
        solved, notes = solve_dials(args, export.model, target.cameras, console, baked=baked)
    if solved is None:
        return None, notes
    if page and attenuation is not None:
        opening, more = initial_dial(solved[0], attenuation.max_sv)
        return [opening], notes + more
    dials, beyond = choose_dials(solved, attenuation)
    return dials, notes + beyond


def dropped_columns(model: Checkpoint) -> list[str]:
    """A note on columns of the model that outputs do not have."""
    from clod_adapter.io.ply import MASK_COLUMNS, inria_dtype
    from clod_adapter.io.ply_settings import COLUMN
    from clod_adapter.io.values import FILTER, dial_columns

    names = (model.vertex.dtype.names if model.vertex is not None else None) or ()
    known = {*(inria_dtype(model.gaussians.sh_degree, dial=dial_columns(names)).names or ()), *MASK_COLUMNS, FILTER}
    others = [name for name in names if name not in known and not name.startswith(COLUMN)]  # the prefix marks settings
    return [f"columns dropped: {', '.join(others)}"] if others else []


def filter_notes(args: Namespace, export: Export, dials: list[float] | None) -> list[str]:
    """A note on an antialiasing filter that readers of the output do not find in the file."""
    suffix = LOD_META if args.lod_meta else ".glb" if args.tiles else suffix_of(Path(args.out))
    drawn, dialled = export.gaussians.screen_filter, export.gaussians.sigma_d is not None and dials is None
    if not drawn.compensate or dialled or suffix in STORE_FILTER:
        return []
    options = 'antiAlias in PlayCanvas, rasterize_mode="antialiased" in gsplat'
    return [f"trained antialiased ({drawn.description}): most readers need an option for it: {options}"]


def write(args: Namespace, export: Export, dials: list[float] | None) -> tuple[list[dict[str, Any]], list[str]]:
    """Writes all files of the command, all or none; a description of each, and notes."""
    from clod_adapter.io.atomic import atomic_path, atomic_paths

    out, outputs, notes = Path(args.out), list[dict[str, Any]](), list[str]()
    if folder_option(args):
        assert dials is not None  # by check
        with atomic_path(out) as folder:
            counts, notes = (export.write_levels if args.lod_meta else export.write_tiles)(folder, dials)
            total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        levels = [{"virtual_scale": dial, "count": count} for dial, count in zip(dials, counts, strict=True)]
        index = str(out / (LOD_META if args.lod_meta else TILESET))
        return [{"file": index, "levels": levels, "count": sum(counts), "bytes": total}], notes
    paths = level_paths(out, args.levels) if args.levels else [out]
    chosen: list[float | None] = [None] if dials is None else [*dials]
    with atomic_paths(*paths) as temporaries:
        for path, temporary, dial in zip(paths, temporaries, chosen, strict=True):
            count, more = export.write(temporary, suffix_of(path), dial)
            taken = temporary.stat().st_size
            outputs.append({"file": str(path), "virtual_scale": dial, "count": count, "bytes": taken})
            notes += more
    return outputs, notes


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
    return f"{line} of {total:,} Gaussians, s = {output['virtual_scale']:.5g}"


def baking_line(target: Target, growth: bool) -> str:
    """The cameras that a baked file is for, and what it lacks."""
    cameras = f"exact at the camera of {target.camera.name} only" if target.camera else f"baked for {target.about}"
    scales = "; the scales include growth" if growth else ""
    return f"{cameras}; lossy: without the dial and the Gaussians culled at this dial value{scales}"


COMMAND = Command(
    summary="Write a file for other tools: another format, or plain.",
    description="""\
Write a model for other tools: in another format, with its dial if the format
can store it, or with one dial value baked in.
""",
    usage="MODEL -o OUT [--sv S | --keep N | ... | --levels S,...]",
    epilog=f"""\
formats, by the suffix of OUT:
  suffix           dial  values
{format_table()}
Without a dial value nothing is baked. Columns that Inria's layout does not have
are dropped.

baking:
  A baked file has the Gaussians of one dial value, with fixed opacities and
  grown scales. This is lossy; keep MODEL. The dial depends on the distance to
  the camera; baking takes each Gaussian's mean distance to the training cameras
  of --images, else to those stored in MODEL, else to 16 placed ones (at worst
  0.5 dB lower). With --camera the file is exact at that camera.

budgets:
  --keep is exact: OUT has N Gaussians. --device-preset is --keep with the
  number that viewers allow a device; a file with fewer is baked at s = 1.
  --psnr-drop and --fps use the calibration in MODEL, which measured the dial;
  files of three captures were at most 0.05 dB below it at equal counts. With
  --images, --fps times frames of MODEL on this machine.

levels and order:
  --levels 1,2,4,7 writes OUT_s1.ply, OUT_s2.ply and so on, all or none. With
  --lod-meta OUT is a new folder with lod-meta.json, level 0 the finest, and the
  chunks that a streaming viewer loads. Its leaves have tables of errors,
  measured from the cameras above, by which the viewer spends its budget of
  Gaussians.
  With --3dtiles OUT is a new folder with tileset.json and .glb tiles, packed
  as in .spz, as CesiumJS wants them; cells have at most 262,144 Gaussians.
  geometricError is measured from the same cameras: with a viewer's default of
  16 pixels a level differs from the finest like a shift of one pixel.
  --order extinction is for renderers that draw the first n rows: for any n
  these are the rows of --keep n, with the opacities and scales of the file.
  They pop where the dial fades.

other tools:
  SIBR reads a baked .ply of SH degree 1 to 3, and takes the degree from
  sh_degree in cfg_args next to the file.
  .html is the page of "clod-adapt view" in one file; --sv or a budget sets its
  initial dial value. Its splat is rounded as in .spz; the PSNR against MODEL is
  measured and printed. With --exact it is float32.
  .sog, .compressed.ply and --lod-meta need splat-transform 3.7 with
  Node 22, on the PATH or in CLOD_SPLAT_TRANSFORM. Without a GPU, 100,000
  Gaussians take minutes for .sog.

examples:
  clod-adapt export garden_clod.ply --sv 2 -o garden_s2.ply
  clod-adapt export garden_clod.ply --keep 200000 -o garden_200k.ply
  clod-adapt export garden_clod.ply --device-preset quest3 -o garden.sog
  clod-adapt export garden_clod.ply --psnr-drop 0.2 -o small.ply
  clod-adapt export garden_clod.ply -o garden.glb
  clod-adapt export garden_clod.ply --images garden -o garden.html
  clod-adapt export garden_clod.ply --levels 1,2,4,7 --lod-meta -o garden_lod
  clod-adapt export garden_clod.ply --levels 1,2,4,7 --3dtiles -o garden_tiles
  clod-adapt export garden_clod.ply --order extinction -o sorted.ply
""",
    add_arguments=add_arguments,
    check=check,
    run=run,
    outputs=outputs,
)
