"""``clod-adapt eval``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.errors import ClodError

from ..shared.command import (
    BUDGETS,
    Command,
    add_activated,
    add_antialiasing,
    add_device,
    add_dial_options,
    add_images,
    check_checkpoint,
    check_dials,
    check_scene,
    model_has_dial,
    page_files,
    run_of,
)
from ..shared.outputs import Outputs, labels


def evaluate_options(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    given.add_argument("model", metavar="MODEL.ply", help="an adapted file, or a plain one as a baseline")
    add_images(given)
    add_activated(given)
    add_antialiasing(given)
    dial = parser.add_argument_group("dial values, one of")
    default = "dial values from 1 (full quality) (default: 1 2 3 5 below the largest trained, and that)"
    add_dial_options(dial, default, "(mean over the held-out views)", several=True)
    measuring = parser.add_argument_group("measuring")
    measuring.add_argument(
        "--base", metavar="BASE.ply", help="also measure the checkpoint, pruned to the count of each row"
    )
    measuring.add_argument(
        "--against", metavar="FILE.ply", nargs="+", default=[],
        help="also measure other files, each beside MODEL.ply at the same number of Gaussians",
    )  # fmt: skip
    measuring.add_argument(
        "--popping", action="store_true", help="also measure how evenly the image changes with the dial and the camera"
    )
    add_device(measuring, "render")
    output = parser.add_argument_group("output")
    output.add_argument("--report", metavar="OUT.html", help="also write a self-contained page, and its charts")


def check_evaluate(args: Namespace) -> None:
    check_dials(args, args.model)
    labels(args.against)
    for path in (args.model, *args.against):
        check_checkpoint(path)
    if args.base:
        check_checkpoint(args.base)
        if model_has_dial(args.base):
            raise ClodError(
                f"{args.base}: has a dial (sigma_d); give --base the checkpoint that was adapted, or use --against"
            )
    check_scene(args.images)


def evaluate_outputs(args: Namespace) -> Outputs:
    if not args.report:
        return Outputs()
    page, *charts = page_files(Path(args.report), ["rendering"])
    inputs = [args.model, *args.against, *([args.base] if args.base else [])]
    return Outputs([page], charts, inputs=inputs, scene=args.images)


EVALUATE = Command(
    summary="Measure quality, count and time at some dial values.",
    description="Measure quality, Gaussians kept and frame time at several dial values.",
    usage="MODEL.ply --images DIR [--sv S [S ...]] [options]",
    epilog=f"""\
{BUDGETS}
columns, over the held-out photographs (every 8th by name):
  PSNR, SSIM  means against the photographs
  kept        Gaussians kept, and their share of all
  in view     of these, the ones with their centre in the image
  frame ms    median time to render an image
  LPIPS, FLIP LPIPS (AlexNet) and mean FLIP; they need the packages lpips and
              flip-evaluator (pip install), and LPIPS's network weights

--base adds two rows per dial value: the base without tuning, reduced to as many
Gaussians by opacity, and by removal error (the error in the training views when
one Gaussian is removed). --against measures a file with a dial at every dial
value, and MODEL.ply at as many Gaussians, or at s = 1.

--popping turns the dial from 1 to the largest S in 200 equal ratios at two
held-out cameras, and moves through five cameras in 200 steps at that S, where
only the dial's changes count. Printed are the RMS change per step (of 255), the
ratio of largest to mean (1 even, 200 a single jump), and the share of the
largest left when the step is halved (0.5 a fade, 1.0 a jump).

Ctrl-C skips unfinished dial values (exit code 0, "interrupted": true; 130 if
none is finished).

examples:
  clod-adapt eval garden_clod.ply --images garden
  clod-adapt eval garden_clod.ply --images garden --sv 1 4 --json > eval.json
  clod-adapt eval garden_clod.ply --images garden --base garden.ply --popping
  clod-adapt eval garden_clod.ply --images garden --against merged.ply cut.ply
  clod-adapt eval garden_clod.ply --images garden --keep 500000 200000
""",
    add_arguments=evaluate_options,
    check=check_evaluate,
    run=run_of("evaluate"),
    outputs=evaluate_outputs,
)
