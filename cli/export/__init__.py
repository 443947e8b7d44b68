"""``clod-adapt export``: writes a model in another format, with its dial or with one dial value baked in."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Sequence
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clod_adapter._support.version import package_version
from clod_adapter.errors import ClodError
from clod_adapter.io import file_formats
from clod_adapter.io.file_formats import Format, check_readable, file_has_dial
from clod_adapter.io.formats.splat_transform import SplatTransform

from ..shared import command as common
from ..shared.console import Console
from ..shared.outputs import Outputs, size

if TYPE_CHECKING:
    from .files import Export

DIGITS = 6  # significant digits of a level, all of them in its file's name
PAGE = ".html"
# Written by splat-transform, which sorts rows along a space-filling curve.
PACKED = {
    ".sog": Format(about=("8 to 16 bits, SH from a palette; by splat-transform",), ordered=False),
    ".compressed.ply": Format(about=("8 to 11 bits; by splat-transform",), ordered=False),
}
FORMATS = {
    **{suffix: file_formats.FORMATS[suffix] for suffix in file_formats.WRITABLE},
    **PACKED,
    PAGE: Format(
        about=("the viewer with the splat, in one file;", "as .spz, or with --exact as float32"),
        ordered=False, carries_sigma=True,
    ),
}  # fmt: skip
STORE_FILTER = (".spz", ".safetensors", PAGE)  # formats in which every reader finds the screen-space filter
FOLDERS = {"--lod-meta": "lod-meta.json", "--3dtiles": "tileset.json"}  # options that make OUT a folder, and its index


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
    about = "scene folder: cameras to bake for, and for the views of a page"
    common.add_reading(given, about, photographs=False)
    given.add_argument(
        "--camera", metavar="PHOTO", help="bake for the camera of this photograph alone; its suffix can be left out"
    )
    dial = parser.add_argument_group("dial values, one of")
    values = common.add_dial_options(dial, "the dial value to bake", "(in the file written)", several=False)
    values.add_argument(
        "--levels", metavar="S,S,...", type=levels_of, help="several dial values, each baked into its own file"
    )
    output = parser.add_argument_group("output")
    output.add_argument("-o", "--out", metavar="OUT", required=True, help="output file; its suffix is the format")
    sets = output.add_mutually_exclusive_group()
    sets.add_argument(
        "--lod-meta", dest="folder", action="store_const", const="--lod-meta",
        help="write the levels as one streaming set for PlayCanvas's viewers, in the new folder OUT",
    )  # fmt: skip
    sets.add_argument(
        "--3dtiles", dest="folder", action="store_const", const="--3dtiles",
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
    common.add_device(output, "time frames for --fps with --images")


def check(args: Namespace) -> None:
    bakes = args.sv is not None or common.given_budget(args) is not None or bool(args.levels)
    page, folder, out = is_page(args), args.folder, Path(args.out)
    refuse(
        (folder and len(args.levels or ()) < 2,
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
    if args.images is not None:
        common.check_scene(args.images)
    if folder:
        refuse(
            (out.suffix.lower() in (".json", *FORMATS),
             f"{out}: with {folder}, --out names the folder for {FOLDERS[folder]}, not a file"),
            (out.exists() and not out.is_dir(), f"{out}: is a file; with {folder}, --out must name a new folder"),
            (not out.name, f"{out}: is the current folder; --out must name a new one"),  # ".", which is not replaced
        )  # fmt: skip
    suffix = "" if folder else suffix_of(out)
    common.check_dials(args, args.model)
    check_readable(Path(args.model))
    dial, form = file_has_dial(Path(args.model)), FORMATS.get(suffix)
    others = ", ".join(other for other, each in FORMATS.items() if each.carries_sigma)
    refuse(
        (bakes and not dial, f"{args.model}: has no sigma_d, so no dial value can be baked; export it without one"),
        (args.order and not dial, f"{args.model}: has no sigma_d to order its Gaussians by; adapt it first"),
        (dial and not bakes and form and not form.carries_sigma,
         f"{out}: {suffix} cannot store a dial; choose a dial value to bake, as in --sv 1, or another format "
         f"({others})"),
        (args.order and form and not form.ordered, f"{out}: {suffix} sorts the Gaussians itself; remove --order"),
    )  # fmt: skip
    if folder == "--lod-meta" or suffix in PACKED:
        SplatTransform.find()


def refuse(*cases: tuple[object, str]) -> None:
    """Raises the first message whose condition holds."""
    for wrong, why in cases:
        if wrong:
            raise ClodError(why)


def suffix_of(out: Path) -> str:
    """The known suffix of ``out``, in lower case."""
    found = [suffix for suffix in FORMATS if out.name.lower().endswith(suffix) and len(out.name) > len(suffix)]
    if not found:
        raise ClodError(f"{out}: --out must end in one of {', '.join(FORMATS)}, which is the format")
    return max(found, key=len)  # .compressed.ply ends in .ply


def is_page(args: Namespace) -> bool:
    return Path(args.out).suffix.lower() == PAGE


def level_paths(out: Path, levels: Sequence[float]) -> list[Path]:
    suffix = out.name[-len(suffix_of(out)) :]
    return [out.with_name(f"{out.name.removesuffix(suffix)}_s{level:g}{suffix}") for level in levels]


def outputs(args: Namespace) -> Outputs:
    out, folder = Path(args.out), bool(args.folder)
    levels = level_paths(out, args.levels) if args.levels and not folder else []
    return Outputs([] if levels else [out], levels, whole=folder, inputs=[args.model], scene=args.images)


def execute(args: Namespace) -> dict[str, Any]:
    from clod_adapter.bake import order_by_extinction
    from clod_adapter.inspection.report import extra_columns

    from ..shared.inputs import on_device, pick_device, read_cameras, read_checkpoint, with_filter
    from ..shared.measure import Stopwatch, choose_dials, solve_dials
    from .files import Export, find_cameras

    console, watch, page = Console(args.quiet), Stopwatch(), is_page(args)
    model = with_filter(read_checkpoint(args.model, console, args.activated), args, console)
    if args.images is not None and args.fps:
        model = on_device(model, pick_device(args.device, console))
    cameras: Sequence[Any] = ()
    about, views, gaussians, attenuation = "", list[Any](), model.gaussians, model.gaussians.attenuation
    counts = common.given_budget(args) and not (page and args.psnr_drop)
    if args.order or args.levels or counts or (args.sv and not page):
        cameras, about = find_cameras(args, model, console)
    if page and args.images is not None:
        views = read_cameras(model, args.images, console)
    if args.order:
        gaussians = gaussians.select(order_by_extinction(gaussians, cameras))
    export = Export(args, model, gaussians, cameras, about, views, console)
    camera = export.camera
    dials = args.levels or solve_dials(args, model, cameras, console, baked=camera is None and not page)
    if dials and page and attenuation is not None:
        dials = [common.initial_dial(dials[0], attenuation.max_sv, console)]
    elif dials:
        dials = choose_dials(dials, attenuation, console)
    names = (model.vertex.dtype.names if model.vertex is not None else None) or ()
    if dropped := extra_columns(names, gaussians.sh_degree):
        console.note(f"columns dropped: {', '.join(dropped)}")
    drawn, dialled = gaussians.screen_filter, gaussians.sigma_d is not None and not dials
    if drawn.compensate and not dialled and (args.folder or suffix_of(Path(args.out)) not in STORE_FILTER):
        options = 'antiAlias in PlayCanvas, rasterize_mode="antialiased" in gsplat'
        console.note(f"trained antialiased ({drawn.description}): most readers need an option for it: {options}")
    written = write(args, export, dials)
    print("\n".join(output_line(output, len(gaussians)) for output in written))
    if dials and not page:
        baked = f"exact at the camera of {camera.name} only" if camera else f"baked for {about}"
        scales = "" if model.gaussians.growth_d is None else "; the scales include growth"
        print(f"{baked}; lossy: without the dial and the Gaussians culled at this dial value{scales}")
    return {
        "command": "export", "version": package_version(), "model": args.model, "base_count": len(gaussians),
        "camera": camera.name if camera else None, "cameras": len(cameras), "order": args.order,
        "outputs": written, "notes": console.notes, "seconds": watch.report(),
    }  # fmt: skip


def write(args: Namespace, export: Export, dials: list[float] | None) -> list[dict[str, Any]]:
    """Writes all files of the command, all or none; a description of each."""
    from clod_adapter.io.atomic import atomic_path, atomic_paths

    out, outputs = Path(args.out), list[dict[str, Any]]()
    if option := args.folder:
        with atomic_path(out) as folder:
            counts = export.write_folder(folder / FOLDERS[option], dials or [])
            total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        levels = [{"virtual_scale": dial, "count": count} for dial, count in zip(dials or [], counts, strict=True)]
        return [{"file": str(out / FOLDERS[option]), "levels": levels, "count": sum(counts), "bytes": total}]
    paths = level_paths(out, args.levels) if args.levels else [out]
    chosen: list[Any] = dials or [None]
    with atomic_paths(*paths) as temporaries:
        for path, temporary, dial in zip(paths, temporaries, chosen, strict=True):
            count = export.write(temporary, suffix_of(path), dial)
            taken = temporary.stat().st_size
            outputs.append({"file": str(path), "virtual_scale": dial, "count": count, "bytes": taken})
    return outputs


def output_line(output: dict[str, Any], total: int) -> str:
    line, dial = f"wrote {output['file']} ({size(output['bytes'])}): {output['count']:,}", output.get("virtual_scale")
    if levels := output.get("levels"):
        shown = ", ".join(f"{level['count']:,} at s = {level['virtual_scale']:.5g}" for level in levels)
        return f"{line} Gaussians in {len(levels)} levels, {shown}"
    if dial is None:
        return f"{line} Gaussians"
    if output["file"].lower().endswith(PAGE):
        return f"{line} Gaussians, initial dial value s = {dial:.5g}"
    return f"{line} of {total:,} Gaussians, s = {dial:.5g}"


def format_table() -> str:
    lines = []
    for suffix, form in FORMATS.items():
        first, *more = form.about
        lines.append(f"  {suffix:<17}{'kept' if form.carries_sigma else '-':<6}{first}")
        lines += [f"{'':25}{line}" for line in more]
    return "\n".join(lines)


SUMMARY = "Write a file for other tools: another format, or plain."
DESCRIPTION = """\
Write a model for other tools: in another format, with its dial if the format
can store it, or with one dial value baked in.
"""
USAGE = "MODEL -o OUT [--sv S | --keep N | ... | --levels S,...]"
EPILOG = f"""\
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
  chunks that a streaming viewer loads; with --3dtiles one with tileset.json and
  .glb tiles, packed as in .spz.
  --order extinction is for renderers that draw the first n rows: for any n
  these are the rows of --keep n, with the opacities and scales of the file.
  They pop where the dial fades.

other tools:
  SIBR reads a baked .ply of SH degree 1 to 3, and takes the degree from
  sh_degree in cfg_args next to the file.
  .html is the page of "clod-adapt view" in one file; --sv or a budget sets its
  initial dial value. The PSNR of its rounded splat is measured and printed.
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
"""
