"""``clod-adapt export``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from itertools import pairwise
from math import inf
from pathlib import Path

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
    model_has_dial,
    run_of,
)
from ..shared.outputs import Outputs
from .export_formats import FORMATS, LOD_META, PACKED, PAGE, TILESET, format_table, level_paths, suffix_of, suffixes

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


def export_options(parser: ArgumentParser) -> None:
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
    add_device(output, "measure for --fps and --psnr-drop with --images")


def check_export(args: Namespace) -> None:
    bakes = bool(args.levels) or args.sv is not None or given_budget(args) is not None
    check_together(args, bakes)
    if args.images is not None:
        check_scene(args.images)
    check_out(args)
    check_dials(args, args.model, measured=measured_budgets(args))
    check_checkpoint(args.model)
    dial = model_has_dial(args.model)
    if bakes and not dial:
        raise ClodError(f"{args.model}: has no sigma_d, so no dial value can be baked; export it without one")
    if args.order and not dial:
        raise ClodError(f"{args.model}: has no sigma_d to order its Gaussians by; adapt it first")
    if folder_option(args) is None:
        check_format(args, bakes, dial)
    if args.lod_meta or (not args.tiles and suffix_of(Path(args.out)) in PACKED):
        SplatTransform.find()


def folder_option(args: Namespace) -> str | None:
    """The option with which OUT is a folder of levels."""
    return "--lod-meta" if args.lod_meta else "--3dtiles" if args.tiles else None


def measured_budgets(args: Namespace) -> tuple[str, ...]:
    """The budgets solved by measuring: frame times at a scene's cameras, PSNR of the file on its photographs."""
    if args.images is None:
        return ()
    page = Path(args.out).suffix.lower() == PAGE
    return ("fps",) if page or args.camera is not None else ("fps", "psnr_drop")


def check_together(args: Namespace, bakes: bool) -> None:
    """Refuses options that do not go together."""
    if args.levels and (args.sv is not None or given_budget(args) is not None):
        raise ClodError("--levels gives the dial values; give no other option for them")
    folder = folder_option(args)
    if args.lod_meta and args.tiles:
        raise ClodError("--lod-meta and --3dtiles write a folder each; give one of them")
    if folder and not (args.levels and len(args.levels) > 1):
        raise ClodError(f"{folder} needs several levels; give them, as in --levels 1,2,4,7")
    if folder and args.order:
        raise ClodError(f"{folder} sorts the Gaussians itself; remove --order")
    if args.camera is not None and args.images is None:
        raise ClodError("--camera needs the scene of the photograph; give --images too")
    page = Path(args.out).suffix.lower() == PAGE
    if page and (args.levels or args.camera is not None or args.order):
        raise ClodError(f"a {PAGE} page contains the whole dial; remove --levels, --camera and --order")
    if args.exact and not page:
        raise ClodError(f"--exact is for {PAGE} pages; another format has its own precision: remove it")
    if args.camera is not None and not bakes:
        raise ClodError("--camera needs a dial value to bake; give one, as in --sv 2")
    if args.images is not None and not (bakes or args.order or page):
        raise ClodError(f"--images is used for baking, --order and {PAGE} only; add one of them, as in --sv 2")


def check_out(args: Namespace) -> None:
    """Refuses an OUT whose suffix is no format, or that cannot be a folder."""
    out = Path(args.out)
    option = folder_option(args)
    if option is None:
        suffix_of(out)
        return
    if out.suffix.lower() in (".json", *suffixes()):
        index = LOD_META if args.lod_meta else TILESET
        raise ClodError(f"{out}: with {option}, --out names the folder for {index}, not a file")
    if out.exists() and not out.is_dir():
        raise ClodError(f"{out}: is a file; with {option}, --out must name a new folder")
    if not out.name:  # ".", the current folder, which cannot be replaced
        raise ClodError(f"{out}: is the current folder; --out must name a new one")


def export_outputs(args: Namespace) -> Outputs:
    out, folder = Path(args.out), folder_option(args) is not None
    levels = level_paths(out, args.levels) if args.levels and not folder else []
    return Outputs([] if levels else [out], levels, whole=folder, inputs=[args.model], scene=args.images)


def check_format(args: Namespace, bakes: bool, dial: bool) -> None:
    """Refuses options that the format of --out cannot store."""
    suffix = suffix_of(Path(args.out))
    if dial and not bakes and not FORMATS[suffix].sigma:
        others = ", ".join(other for other in suffixes() if FORMATS[other].sigma)
        raise ClodError(
            f"{args.out}: {suffix} cannot store a dial; choose a dial value to bake, as in --sv 1, or another format "
            f"({others})"
        )
    if args.order and not FORMATS[suffix].ordered:
        raise ClodError(f"{args.out}: {suffix} sorts the Gaussians itself; remove --order")


EXPORT = Command(
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
  number that viewers allow a device; a file with fewer is baked at s = 1. With
  --images, --psnr-drop finds the smallest file that measures at most DB below
  MODEL at s = 1 on the held-out photographs (splat-transform's rounding is
  measured afterwards), and --fps times frames of MODEL. Without --images both
  use the calibration in MODEL.

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
  Node 22, on the PATH or in CLOD_SPLAT_TRANSFORM; "clod-adapt doctor" prints
  how to install it. Without a GPU, 100,000 Gaussians take minutes for .sog.

examples:
  clod-adapt export garden_clod.ply --sv 2 -o garden_s2.ply
  clod-adapt export garden_clod.ply --keep 200000 -o garden_200k.ply
  clod-adapt export garden_clod.ply --device-preset quest3 -o garden.sog
  clod-adapt export garden_clod.ply --psnr-drop 0.2 --images garden -o small.ply
  clod-adapt export garden_clod.ply -o garden.glb
  clod-adapt export garden_clod.ply --images garden -o garden.html
  clod-adapt export garden_clod.ply --levels 1,2,4,7 --lod-meta -o garden_lod
  clod-adapt export garden_clod.ply --levels 1,2,4,7 --3dtiles -o garden_tiles
  clod-adapt export garden_clod.ply --order extinction -o sorted.ply
""",
    add_arguments=export_options,
    check=check_export,
    run=run_of("export.run"),
    outputs=export_outputs,
)
