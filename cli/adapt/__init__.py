"""``clod-adapt``, the main command: its text, options and checks; ``run`` is in ``adapt.run``."""

from argparse import ArgumentParser, Namespace
from typing import Any

from clod_adapter import ClodError

from ..shared.command import (
    add_input,
    add_out,
    add_reading,
    add_settings,
    check_inputs,
    make_config,
    page_files,
)
from ..shared.outputs import AdaptFiles, Outputs, Report, check_ply_name

# As in clod_adapter.training.plan, which imports torch; a test compares the two.
NAMES = ("bands", "means", "quats", "scales", "opacities", "sh0")


def add_arguments(parser: ArgumentParser) -> None:
    text = (
        "checkpoint: a PLY in Inria's 3DGS layout, or another file that inspect reads; never"
        " modified"
    )
    given = add_input(parser, "ply", "PLY", text)
    scene = (
        "images/ with a COLMAP model in sparse/0, or a transforms.json of nerfstudio or instant-ngp"
    )
    add_reading(given, f"scene folder: {scene} (default: none, see below)")
    text = "output file (default: name of PLY with _clod, in the current folder)"
    output = add_out(parser, "OUT.ply", text)
    output.add_argument(
        "--report", action="store_true", help="also write a page, OUT.html, and its charts"
    )
    training = parser.add_argument_group("training")
    add_settings(training)
    training.add_argument(
        "--resume", action="store_true", help="continue the same command where it was interrupted"
    )
    text = "exit code 0 even if s = 1 is far below the base (see exit codes)"
    training.add_argument("--accept-loss", action="store_true", help=text)
    options = parser.add_argument_group("advanced")
    several: Any = {
        "metavar": "NAME",
        "nargs": "+",
        "action": "extend",
        "choices": NAMES,
        "default": [],
    }
    text = f"train these whatever the plan measures: {', '.join(NAMES)}"
    options.add_argument("--with", dest="keep_in", help=text, **several)
    text = "exclude or freeze these whatever the plan measures"
    options.add_argument("--without", dest="leave_out", help=text, **several)


def check(args: Namespace) -> None:
    make_config(args)
    if both := sorted(set(args.keep_in) & set(args.leave_out)):
        raise ClodError(
            f"--with and --without both name {', '.join(both)}; give each to one of them"
        )
    check_inputs(args.images, args.ply)


def outputs(args: Namespace) -> Outputs:
    files = AdaptFiles.of(args.ply, args.out)
    check_ply_name(files.ply, "--out")
    page = page_files(files.ply.with_suffix(".html"), "adapting") if args.report else []
    named, default = ([], [files.ply]) if args.out is None else ([files.ply], [])
    derived = [*default, files.adapter, files.report, files.state, *page]
    return Outputs(named, derived, inputs=[args.ply], scene=args.images)


def execute(args: Namespace) -> Report:
    from .run import adapt

    return adapt(args)


DESCRIPTION = """\
Give a trained 3D Gaussian splat a quality dial: one file for every budget.

Learns two numbers per Gaussian: sigma_d, by which a renderer fades detail out
with distance, and growth_d, by which the others grow into the gaps. The dial s
is set when rendering: 1 is full quality; at s about s^-1.5 of them are drawn.
"""
USAGE = "PLY [--images DIR] [--max-sv S] [--out OUT.ply] [options]"
EPILOG = """\
outputs (existing files are replaced):
  OUT.ply          the splat with sigma_d and growth_d; its header has a table
                   of dial value, count, PSNR, SSIM and frame time
  OUT.safetensors  the adapter: "clod-adapt apply" rebuilds OUT.ply from it
  OUT.json         the report: settings, machine, times, and quality on held-out
                   photographs (every 8th by name) per dial value
  OUT.html, OUT_count.png, OUT_rendering.png, OUT_adapting.png
                   with --report: a self-contained page and its charts; needs
                   matplotlib (pip install matplotlib)
The same seed gives the same Gaussians, bit for bit, on as many threads; so does
a run that was resumed.

without --images:
  Cameras are placed, and the checkpoint itself renders the target images: all
  quality numbers are relative to it. Photographs give a better result.

interruption:
  Ctrl-C, SIGTERM, a closed terminal or the warning of a scheduler (SIGUSR1,
  SIGUSR2, SIGXCPU) ends training after the step and writes the result so far
  (exit code 0, "interrupted": true); a second Ctrl-C or SIGTERM aborts. The
  state is saved in OUT.resume.safetensors about once a minute: after that, a
  crash or a full disk the same command with --resume gives the same Gaussians.

several processes:
  Processes of torchrun train together, with the result of one process with the
  same --batch, up to rounding.

exit codes: 0 written; 1 written, but a loss was not finite, or s = 1 is more
than 1 dB below the base (without photographs: below 25 dB) and --accept-loss is
not given, or a fault of this program; 2 bad input or a full disk; 130
interrupted without a result

examples:
  clod-adapt garden.ply --images garden --max-sv 5
  clod-adapt garden.ply --images garden --time-budget 120 --out out/dial.ply
  clod-adapt garden.ply
  torchrun --nproc-per-node 8 -m clod_adapter garden.ply --images garden
"""
