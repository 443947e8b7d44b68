"""``clod-adapt export``: writes a model in another format, with its dial or with one dial value
baked in.
"""

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from itertools import pairwise
from math import inf
from pathlib import Path

from clod_adapter import ClodError
from clod_adapter.config import MULTIPLIER
from clod_adapter.io.file_formats import file_has_dial
from clod_adapter.io.formats.splat_transform import SplatTransform

from ..shared import command as common
from ..shared.outputs import Outputs, Report
from .names import AGREE, CONVERTED, FOLDERS, FORMATS, PAGE, is_page, level_paths, suffix_of

DIGITS = 6  # significant digits of a level, all of them in its file's name


def levels_of(text: str) -> list[float]:
    """Parses ``1,2,4,7``."""
    try:
        levels = [float(f"{float(word):.{DIGITS}g}") for word in text.split(",")]
    except ValueError:
        levels = []
    if not levels or levels[0] < 0 or not all(a < b for a, b in pairwise([*levels, inf])):
        raise ArgumentTypeError(
            f"{text!r} must be ascending dial values of at least 0, as in 1,2,4,7"
        )
    return levels


def add_arguments(parser: ArgumentParser) -> None:
    given = common.add_input(parser, "model", "MODEL", "an adapted file, or a plain one to convert")
    given.add_argument(
        "others", metavar="OTHER", nargs="*", help=f"more of them, to switch to in an {PAGE} page"
    )
    about = "scene folder: cameras to bake for, and for the views of a page"
    common.add_reading(given, about, photographs=False)
    given.add_argument(
        "--camera", metavar="PHOTO", help="bake for the camera of this photograph alone"
    )
    dial = parser.add_argument_group("dial values, one of")
    values = common.add_dial_options(
        dial, "the dial value to bake", "(in the file written)", several=False
    )
    values.add_argument(
        "--levels", metavar="S,S,...", type=levels_of, help="dial values, each baked into a file"
    )
    output = common.add_out(parser, "OUT", "output file; its suffix is the format", required=True)
    sets = output.add_mutually_exclusive_group()
    for option, form in (
        ("--lod-meta", "streaming set for PlayCanvas's viewers"),
        ("--3dtiles", "3D Tiles set"),
    ):
        text = f"write a {form}, a level for each band of distance, to the new folder OUT"
        sets.add_argument(option, dest="folder", action="store_const", const=option, help=text)
    text = (
        "ratio of the distances at which two levels begin, as set in the viewer (default:"
        f" {MULTIPLIER:g})"
    )
    output.add_argument("--multiplier", metavar="M", type=float, default=MULTIPLIER, help=text)
    text = (
        "fit view-dependent colours, most of a file's bytes, to this SH degree, 0 to 3; auto: the"
        f" lowest whose renders have {AGREE:g} dB against the file's"
    )
    output.add_argument("--sh-degree", metavar="N", choices=["0", "1", "2", "3", "auto"], help=text)
    text = "fine-tune what is baked for a dial value on the photographs of --images"
    output.add_argument("--tune", action="store_true", help=text)
    output.add_argument(
        "--exact",
        action="store_true",
        help="an .html page with float32 values: eight times the size",
    )
    common.add_device(output, "tune, or time frames for --fps with --images,")


def check(args: Namespace) -> None:
    bakes = args.sv is not None or common.given_budget(args) is not None or bool(args.levels)
    page, folder, out = is_page(args), args.folder, Path(args.out)
    refuse(
        (
            args.others and not page,
            f"{len(args.others) + 1} models are for an {PAGE} page; export one at a time",
        ),
        (
            args.others and args.sh_degree,
            "--sh-degree is for one model; export each with it before the page",
        ),
        (
            folder and bakes,
            f"{folder} has levels by distance, no dial value; remove --levels, --sv or the budget",
        ),
        (
            args.multiplier != MULTIPLIER and not folder,
            f"--multiplier is for {' and '.join(FOLDERS)}; add one of them",
        ),
        (
            args.camera and args.images is None,
            "--camera needs the scene of the photograph; give --images too",
        ),
        (
            page and (args.levels or args.camera is not None),
            f"a {PAGE} page contains the whole dial; remove --levels and --camera",
        ),
        (
            args.camera and not bakes,
            "--camera needs a dial value to bake; give one, as in --sv 2",
        ),
        (
            args.tune and (page or not bakes or args.images is None or args.camera is not None),
            "--tune is for what is baked for all cameras: give --images, --sv 2, and no --camera",
        ),
        (
            args.exact and not page,
            f"--exact is for {PAGE} pages; another format has its own precision: remove it",
        ),
        (
            args.images is not None and not (bakes or page or args.sh_degree),
            f"--images is for baking, --sh-degree and {PAGE} only; add one, as in --sv 2",
        ),
        (
            folder and out.suffix.lower() in (".json", *FORMATS),
            f"{out}: with {folder}, --out names the folder for {FOLDERS.get(folder)}, not a file",
        ),
        (
            folder and out.exists() and not out.is_dir(),
            f"{out}: is a file; with {folder}, --out must name a new folder",
        ),
        # "." is never replaced
        (folder and not out.name, f"{out}: is the current folder; --out must name a new one"),
    )
    suffix = "" if folder else suffix_of(out)
    common.check_dials(args, args.model)
    common.check_inputs(args.images, args.model, *args.others)
    dial, form = file_has_dial(Path(args.model)), FORMATS.get(suffix)
    others = ", ".join(other for other, each in FORMATS.items() if each.carries_sigma)
    refuse(
        (
            (bakes or folder) and not dial,
            f"{args.model}: has no sigma_d, so no dial values or levels; adapt it first",
        ),
        (
            dial and not bakes and form and not form.carries_sigma,
            f"{out}: {suffix} cannot store a dial; bake one, as in --sv 1, or choose of {others}",
        ),
    )
    if folder == "--lod-meta" or suffix in CONVERTED:
        SplatTransform.find()


def refuse(*cases: tuple[object, str]) -> None:
    """Raises the first message whose condition holds."""
    for wrong, why in cases:
        if wrong:
            raise ClodError(why)


def outputs(args: Namespace) -> Outputs:
    out, folder = Path(args.out), bool(args.folder)
    levels = level_paths(out, args.levels) if args.levels and not folder else []
    return Outputs(
        [] if levels else [out],
        levels,
        whole=folder,
        inputs=[args.model, *args.others],
        scene=args.images,
    )


def execute(args: Namespace) -> Report:
    from .files import export

    return export(args)


DESCRIPTION = "Write a model for other tools, with its dial or with one dial value baked in."
TABLE = "\n".join(
    f"  {suffix:<17}{'kept' if form.carries_sigma else '-':<6}" + f"\n{'':25}".join(form.about)
    for suffix, form in FORMATS.items()
)
USAGE = "MODEL [OTHER ...] -o OUT [--sv S | --keep N | ...]"
EPILOG = f"""\
formats, by the suffix of OUT:
  suffix           dial  values
{TABLE}
Without a dial value nothing is baked. Columns that Inria's layout does not have
are dropped.

baking:
  A baked file has the Gaussians of one dial value, with fixed opacities and
  grown scales. This is lossy; keep MODEL. Baking takes each Gaussian's mean
  distance to the training cameras of --images, else to those stored in MODEL,
  else to 16 placed ones. With --camera the file is exact at that camera.
  Where MODEL was adapted without photographs, and no --images is given, the
  checkpoint is merged to as many too, by importance in renders, and written if
  it looks more like itself.
  --keep is exact. --psnr-drop and --fps use the quality table in MODEL; with
  --images, --fps times frames of MODEL on this machine.

levels:
  --levels 1,2,4,7 writes OUT_s1.ply, OUT_s2.ply and so on, all or none.
  --lod-meta, and --3dtiles for CesiumJS, make OUT a new folder with a set of
  levels. The finest is the checkpoint; each other one is baked for a band of
  distances M times as far as the one before, and the last one has at least 1 %
  of the Gaussians. Viewers draw each part of a scene at the level of its band.

tuning:
  --tune takes minutes for each file. A file of one dial value gains a little,
  one beyond the trained range several dB. MODEL itself stays as it is.

SH degree:
  --sh-degree 1 saves 144 of 248 bytes for each Gaussian of degree 3 in a .ply.
  The degrees that remain are fitted to the colours that the cameras see, by
  least squares; a note has the PSNR against the file as it was. auto takes the
  lowest degree that the eye does not tell from it.

other tools:
  SIBR reads a baked .ply of SH degree 1 to 3, and takes the degree from
  sh_degree in cfg_args next to the file.
  .html is the page of "clod-adapt view" in one file, of one model or several;
  --sv or a budget sets its initial dial value. .glb, .sog, .compressed.ply
  and --lod-meta need splat-transform 3.7 with Node 22, on the PATH or in
  CLOD_SPLAT_TRANSFORM.

examples:
  clod-adapt export garden_clod.ply --keep 200000 -o garden_200k.ply
  clod-adapt export garden_clod.ply --images garden -o garden.html
  clod-adapt export garden_clod.ply --3dtiles -o garden_tiles
"""
