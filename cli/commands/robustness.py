"""``clod-adapt robustness``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.report.style import check_matplotlib

from ..shared.files import labels
from ..shared.outputs import check_no_input
from .checks import check_checkpoint, check_makeable, check_scene
from .command import Command
from .options import add_activated, add_antialiasing, add_device, add_images
from .settings import add_settings, make_configs


def robustness_options(parser: ArgumentParser) -> None:
    parser.add_argument("ply", metavar="PLY", nargs="+", help="checkpoints of one scene; they are never modified")
    add_images(parser)
    parser.add_argument(
        "--max-sv", metavar="S", type=float, nargs="+", default=[1.0, 3.0, 5.0, 7.0],
        help="the ranges: largest dial value of each adaptation; 1 adapts at full detail only (default: 1 3 5 7)",
    )  # fmt: skip
    add_settings(parser, without=["max_sv"])
    parser.add_argument(
        "-o", "--out", metavar="DIR", default="robustness",
        help="where everything goes and is resumed from (default: robustness)",
    )  # fmt: skip
    parser.add_argument(
        "--misaligned-ok", action="store_true", help="train even where a checkpoint does not fit the photographs"
    )
    add_device(parser, "train and measure")
    add_activated(parser)
    add_antialiasing(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")


def check_robustness(args: Namespace) -> None:
    check_matplotlib()
    make_configs(args)
    labels(args.ply)
    for folder in (Path(args.out), Path(args.out) / "cells"):
        check_makeable(folder)
    for path in args.ply:
        check_checkpoint(path)
    check_scene(args.images)
    folder = Path(args.out)
    there = [*folder.glob("robustness.*"), *(folder / "cells").glob("*")]
    check_no_input(there, args.ply, args.images)


ROBUSTNESS = Command(
    module="robustness",
    summary="Adapt checkpoints at several ranges, and plot them.",
    description="""\
The robustness experiment of CLoD-GS: does a dial take on any checkpoint?

Adapts each checkpoint, say a plain and a mask-pruned one of the same scene, at
each range of the dial, and measures all of them at the same dial values on the
held-out photographs, beyond their own range too. The baseline of each is the
untouched checkpoint with only its most opaque Gaussians kept, nothing tuned.
""",
    usage="PLY [PLY ...] --images DIR [options]",
    epilog="""\
in DIR afterwards (default: robustness):
  robustness.png   a row a checkpoint: PSNR and SSIM against Gaussians kept,
                   distributions of opacity and sigma_d, a line a range
  robustness.csv   a line a measurement
  robustness.json  all of it, with settings, machine and histograms
  cells/           what each adaptation learned, and its rows; a model is made
                   from it with "clod-adapt apply PLY cells/NAME_sv5.safetensors
                   -o NAME_sv5.ply"

Interrupted runs resume: a cell that is on disk, of the same files, photographs,
settings and version, is not run again. Ctrl-C drops the cell under way and
writes figure, CSV and JSON of those there are (exit code 0, "interrupted":
true); with none, exit code 130. To start afresh, remove DIR.

example:
  clod-adapt robustness 3dgs.ply mask.ply --images garden --max-sv 1 3 5 7
""",
    add_arguments=robustness_options,
    check=check_robustness,
)
