"""``clod-adapt eval``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.errors import ClodError

from ..shared.dials import BUDGETS, add_dial_options
from ..shared.files import labels
from ..shared.outputs import check_outputs
from .checks import check_checkpoint, check_dials, check_scene, has_dial, page_files
from .command import Command
from .options import add_activated, add_antialiasing, add_device, add_images


def evaluate_options(parser: ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL.ply", help="an adapted file, or a plain one as the baseline")
    add_images(parser)
    default = "dial values, 1 (full quality) and up (default: 1 2 3 5 as far as trained, and the last one trained)"
    add_dial_options(parser, default, "(mean over the held-out views)", several=True, required=False)
    parser.add_argument(
        "--base", metavar="BASE.ply", help="also the unadapted checkpoint, cut by rank to as many Gaussians as each row"
    )
    parser.add_argument(
        "--against", metavar="FILE.ply", nargs="+", default=[],
        help="also other files, and beside each MODEL.ply at the dial value that keeps as many Gaussians",
    )  # fmt: skip
    parser.add_argument(
        "--popping", action="store_true", help="also how evenly the picture changes with the dial and with the camera"
    )
    parser.add_argument("--report", metavar="OUT.html", help="also a page to look at, and beside it its charts")
    add_device(parser, "render")
    add_activated(parser)
    add_antialiasing(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")


def check_evaluate(args: Namespace) -> None:
    check_dials(args, args.model)
    labels(args.against)
    for path in (args.model, *args.against):
        check_checkpoint(path)
    if args.base:
        check_checkpoint(args.base)
        if has_dial(args.base):
            raise ClodError(
                f"{args.base}: has a dial (sigma_d); give --base the checkpoint that was adapted, or give it to "
                "--against"
            )
    check_scene(args.images)
    if args.report:
        inputs = [args.model, *args.against, *([args.base] if args.base else [])]
        page, *charts = page_files(Path(args.report), ["rendering"])
        check_outputs([page], inputs, args.images, beside=charts)


EVALUATE = Command(
    module="evaluate",
    summary="Measure quality, count and time at some dial values.",
    description="Measure quality, Gaussians kept and frame time at several dial values.",
    usage="MODEL.ply --images DIR [--sv S [S ...]] [options]",
    epilog=f"""\
{BUDGETS}
All numbers are over the held-out photographs (every 8th by name):
  PSNR, SSIM  means against the photographs
  kept        Gaussians that the dial leaves in, and their share of all
  in view     those of them that have their centre in the picture
  frame ms    median time to render a picture
  LPIPS, FLIP the picture's distance as seen: LPIPS with AlexNet, the mean of
              FLIP; where pip install 'clod-adapter[eval]' put their packages,
              and LPIPS its network's weights, which are not downloaded here
A checkpoint without a dial shows the same at every value: the baseline.

With --base each row is followed by the base, untouched, at the same count: the
Gaussians of highest opacity, and those of highest removal error, the error that
leaving one out alone makes in the photographs trained on. With --against a file
that has a dial itself is measured at every dial value; the model keeps as many
as a mean over the held-out views, at most what it keeps at s = 1.

--popping turns the dial from 1 to the largest S in 200 equal ratios before two
held-out cameras, and moves through five neighbouring cameras in 200 steps at
that S; of a moving camera only what the dial does is counted, not the motion.
Per step: the change of the picture (root mean square, levels of 255), the
largest against the mean (1 is even, 200 a single switch), and how much of the
largest is left when the step is halved: 0.5 of a fade, 1.0 of a jump.

--report writes one self-contained page: a held-out view under a slider, error
against milliseconds a frame, all rows, the settings; and OUT_rendering.png.

Ctrl-C skips the dial values that are not finished (exit code 0, "interrupted":
true); before the first one is, there is nothing to print (exit code 130).

examples:
  clod-adapt eval garden_clod.ply --images garden
  clod-adapt eval garden.ply --images garden --sv 1
  clod-adapt eval garden_clod.ply --images garden --sv 1 4 --json > eval.json
  clod-adapt eval garden_clod.ply --images garden --base garden.ply --popping
  clod-adapt eval garden_clod.ply --images garden --against merged.ply cut.ply
  clod-adapt eval garden_clod.ply --images garden --keep 500000 200000
  clod-adapt eval garden_clod.ply --images garden --report garden.html
""",
    add_arguments=evaluate_options,
    check=check_evaluate,
)
