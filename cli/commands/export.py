"""``clod-adapt export``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from itertools import pairwise
from math import inf
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import check_target
from clod_adapter.io.formats.splat_transform import SplatTransform

from ..shared.dials import add_dial_options, given_budget
from ..shared.outputs import check_outputs
from .checks import check_checkpoint, check_dials, check_scene, has_dial
from .command import Command
from .export_formats import FORMATS, LOD_META, PACKED, PAGE, format_table, level_paths, suffix_of, suffixes
from .options import add_activated, add_antialiasing, add_device

DIGITS = 6  # significant ones of a level, all of which its file's name has


def levels_of(text: str) -> list[float]:
    """The dial values of ``1,2,4,7``."""
    try:
        levels = [float(f"{float(word):.{DIGITS}g}") for word in text.split(",")]
    except ValueError:
        levels = []
    if not levels or levels[0] < 1 or not all(a < b for a, b in pairwise([*levels, inf])):
        raise ArgumentTypeError(f"{text!r} must be rising dial values of at least 1, as in 1,2,4,7")
    return levels


def export_options(parser: ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL", help="an adapted file, or a plain one to convert")
    parser.add_argument(
        "-o", "--out", metavar="OUT", required=True, help="what to write, by its suffix; replaced if it exists"
    )
    add_dial_options(parser, "the dial value to bake", "(in the file written)", several=False, required=False)
    parser.add_argument(
        "--levels", metavar="S,S,...", type=levels_of,
        help="several dial values, each baked into a file of its own, OUT_s1.ply, OUT_s2.ply, ...; all or none appear",
    )  # fmt: skip
    parser.add_argument(
        "--lod-meta", action="store_true",
        help="the levels as one streaming set in the new folder OUT, for PlayCanvas's viewers (by splat-transform)",
    )  # fmt: skip
    parser.add_argument(
        "--camera", metavar="PHOTO", help="bake for this photograph's camera alone; its name, with or without suffix"
    )
    parser.add_argument(
        "--images", metavar="DIR", help="the scene: its cameras to bake for, to order by, or for a page's views"
    )
    parser.add_argument(
        "--order", choices=["extinction"],
        help="put the rows in the order in which the dial keeps them longest, for renderers that draw a prefix",
    )  # fmt: skip
    add_device(parser, "measure, for --fps and --psnr-drop with --images")
    add_activated(parser)
    add_antialiasing(parser, photographs=False)
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")


def check_export(args: Namespace) -> None:
    bakes = bool(args.levels) or args.sv is not None or given_budget(args) is not None
    check_together(args, bakes)
    if args.images is not None:
        check_scene(args.images)
    check_export_outputs(args)
    check_dials(args, args.model, measured=measured(args))
    check_checkpoint(args.model)
    dial = has_dial(args.model)
    if bakes and not dial:
        raise ClodError(f"{args.model}: has no sigma_d, so there is no dial value to bake; it is plain already")
    if args.order and not dial:
        raise ClodError(f"{args.model}: has no sigma_d, so there is no order to put its rows in; adapt it first")
    if not args.lod_meta:
        check_format(args, bakes, dial)
    if args.lod_meta or suffix_of(Path(args.out)) in PACKED:
        SplatTransform.find()


def measured(args: Namespace) -> tuple[str, ...]:
    """The budgets that are measured: frame times from a scene's cameras, the PSNR of a file on its photographs."""
    if args.images is None:
        return ()
    page = Path(args.out).suffix.lower() == PAGE
    return ("fps",) if page or args.camera is not None else ("fps", "psnr_drop")


def check_together(args: Namespace, bakes: bool) -> None:
    """Refuses options that do not go together."""
    if args.levels and (args.sv is not None or given_budget(args) is not None):
        raise ClodError("--levels has the dial values; give no other with it")
    if args.lod_meta and not args.levels:
        raise ClodError("--lod-meta is a set of levels; give them, as in --levels 1,2,4,7")
    if args.lod_meta and args.order:
        raise ClodError("a streaming set has an order of its own; leave out --order")
    if args.camera is not None and args.images is None:
        raise ClodError("--camera names a photograph of a scene; give that too, with --images")
    page = Path(args.out).suffix.lower() == PAGE
    if page and (args.levels or args.camera is not None or args.order):
        raise ClodError(f"a {PAGE} shows the whole dial; leave out --levels, --camera and --order")
    if args.camera is not None and not bakes:
        raise ClodError("--camera is where a dial value is baked for; give one, as in --sv 2")
    if args.images is not None and not (bakes or args.order or page):
        raise ClodError(f"--images is for baking, --order and a {PAGE}; give one of them with it, as in --sv 2")


def check_export_outputs(args: Namespace) -> None:
    out = Path(args.out)
    if not args.lod_meta:
        for path in level_paths(out, args.levels) if args.levels else [out]:
            suffix_of(path)
            check_outputs([path], [args.model], args.images)
        return
    if out.suffix.lower() in (".json", *suffixes()):
        raise ClodError(f"{out}: with --lod-meta, --out names the folder that {LOD_META} is to be in, not a file")
    if out.exists() and not out.is_dir():
        raise ClodError(f"{out}: is a file; with --lod-meta give --out the name of a new folder")
    if not out.name:  # ".", the folder one is in, which cannot be put in the place of itself
        raise ClodError(f"{out}: is the folder you are in; give --out the name of a new one")
    check_target(out)


def check_format(args: Namespace, bakes: bool, dial: bool) -> None:
    """Refuses what the format of --out has no room for."""
    suffix = suffix_of(Path(args.out))
    if dial and not bakes and not FORMATS[suffix].sigma:
        others = ", ".join(other for other in suffixes() if FORMATS[other].sigma)
        raise ClodError(
            f"{args.out}: {suffix} has no room for sigma_d; choose a dial value to bake, as in --sv 1, or another "
            f"format ({others})"
        )
    if args.order and not FORMATS[suffix].ordered:
        raise ClodError(f"{args.out}: {suffix} has an order of its own; leave out --order")


EXPORT = Command(
    module="export.run",
    summary="Write a file for other tools: another format, or plain.",
    description="""\
Write a model for other tools: in another format, with its dial where the format
has room for it, or with one dial value baked in, for viewers without a dial.
""",
    usage="MODEL -o OUT [--sv S | --keep N | ... | --levels S,...]",
    epilog=f"""\
by the suffix of OUT:
  suffix           dial  values
{format_table()}
Where the dial is kept and no dial value is given, nothing is baked. A plain
MODEL is converted. Columns that Inria's layout does not have are left out.

Baking keeps the Gaussians of one dial value, with opacities for good: lossy.
The dial fades a Gaussian by its distance from the camera, and a plain file has
no camera: each Gaussian has its mean distance from the training cameras, those
of --images, else up to 16 that adapting stores in MODEL, else 16 that are
placed where MODEL looks photographed, which lost 0.5 dB at worst. At equal
counts files for training cameras measured 0.05 dB below to 0.6 dB above the
dial with --max-sv 5 (benchmarks/bake.py). With --camera it is how the dial
looks from there, exact from that place and near it. Keep the adapted file: this
cannot be undone.

--keep is exact: OUT has N Gaussians. With --images --psnr-drop writes the
smallest file that, as read back, is at most DB below MODEL at s = 1 on the
held-out photographs, and --json has its PSNR; what splat-transform rounds is
measured after. --fps then times frames of MODEL first. Without --images both
are found in the calibration stored in MODEL, which is of the dial and, for
frame times, of the machine that a note names.

--levels 1,2,4,7 writes OUT_s1.ply, OUT_s2.ply and so on. With --lod-meta OUT is
a folder that must not be there yet (or be empty): lod-meta.json, level 0 the
finest, and the chunks that a streaming viewer loads.

--order extinction is for renderers that draw the first n rows, whatever n: the
first n are those that --keep n writes. They are drawn with the opacities that
stand in the file: on two captures 0.1 to 0.6 dB below the dial at many rows, up
to 0.8 above it at few (benchmarks/prefix.py), and they pop where it fades.

SIBR reads a baked .ply; the SH degree it takes from sh_degree in the cfg_args
beside the model, up to 3, and its released versions do not show degree 0.

A .html is what "clod-adapt view" shows, in one file to send to somebody; it
needs no network. --sv, or a budget, is where its dial stands at first, and
--images gives it the photographs' cameras to jump between.

.sog, .compressed.ply and --lod-meta need splat-transform 3.7 with Node 22, on
the PATH or as the command in CLOD_SPLAT_TRANSFORM. In a folder of its own:
  npm install node@22 @playcanvas/splat-transform@3.7
  PATH=$PWD/node_modules/node/bin:$PWD/node_modules/.bin:$PATH
Without a GPU, SOG's spherical harmonics take minutes for 100,000 Gaussians.

examples:
  clod-adapt export garden_clod.ply --sv 2 -o garden_s2.ply
  clod-adapt export garden_clod.ply --keep 200000 -o garden_200k.ply
  clod-adapt export garden_clod.ply --psnr-drop 0.2 --images garden -o small.ply
  clod-adapt export garden_clod.ply --sv 3 --camera a.jpg --images garden \\
      -o from_a.ply
  clod-adapt export garden_clod.ply -o garden.glb
  clod-adapt export garden_clod.ply --images garden -o garden.html
  clod-adapt export garden_clod.ply --levels 1,2,4,7 -o garden.ply
  clod-adapt export garden_clod.ply --levels 1,2,4,7 --lod-meta -o garden_lod
  clod-adapt export garden_clod.ply --order extinction --images garden \\
      -o sorted.ply
""",
    add_arguments=export_options,
    check=check_export,
)
