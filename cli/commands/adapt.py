"""``clod-adapt``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.blocks.memory import parse_size
from clod_adapter.errors import ClodError

from ..shared.files import Outputs
from ..shared.launch import launched
from .checks import check_checkpoint, check_scene, page_files
from .command import Command
from .options import add_activated, add_antialiasing, add_device
from .settings import add_settings, make_config

# As in clod_adapter.training.plan, which would import torch; a test compares the two.
NAMES = ("bands", "unseen", "means", "quats", "scales", "opacities", "sh0")

PLAN = """\
Before training a plan is printed: what the scene does not need, by which
number, and the option that overrules it. Higher SH bands are left out where the
training views change by less than 0.02 dB without them, Gaussians where they
move no pixel of any, and an attribute is frozen where tuning it can do less
than 0.02 dB. What was left out is in OUT.ply as it was; with --trim it is not,
and OUT.ply is smaller. --with and --without settle it beforehand, for bands,
unseen (Gaussians), means, quats, scales, opacities and sh0. A training of fewer
than 300 steps freezes no attribute by itself.
"""


def add_plan_options(parser: ArgumentParser) -> None:
    for option, dest, what in (
        ("--with", "keep_in", "train with these, whatever the plan would find: "),
        ("--without", "leave_out", "leave these out or frozen, likewise"),
    ):
        names = ", ".join(NAMES) if dest == "keep_in" else ""
        parser.add_argument(
            option, dest=dest, metavar="NAME", nargs="+", action="extend", choices=NAMES, default=[], help=what + names
        )
    parser.add_argument("--trim", action="store_true", help="do not write the bands and Gaussians that were left out")


def adapt_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "ply",
        metavar="PLY",
        help="the checkpoint: a PLY in Inria's 3DGS layout, or another file that inspect reads; never modified",
    )
    parser.add_argument(
        "--images", metavar="DIR",
        help="the scene: photographs in DIR/images and their COLMAP model in DIR/sparse/0, or nerfstudio's or "
        "instant-ngp's DIR/transforms.json (default: none, see below)",
    )  # fmt: skip
    add_settings(parser)
    add_plan_options(parser)
    parser.add_argument(
        "-o", "--out", metavar="OUT.ply", help="output (default: PLY's name with _clod, in this folder)"
    )
    parser.add_argument(
        "--memory", metavar="SIZE", help="stay below this, as in 8GB: where the whole does not fit, train it in blocks"
    )
    parser.add_argument(
        "--block", metavar="N", help="do only the start, or only block N, of a run with --memory; without it the same "
        "command does what is missing, and puts all together",
    )  # fmt: skip
    parser.add_argument("--resume", action="store_true", help="go on with the same command where it was interrupted")
    add_device(parser, "train and measure")
    parser.add_argument(
        "--misaligned-ok", action="store_true", help="train even where a checkpoint does not fit the photographs"
    )
    parser.add_argument("--report", action="store_true", help="also a page to look at, OUT.html, and its charts")
    add_activated(parser)
    add_antialiasing(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")


def check_adapt(args: Namespace) -> None:
    make_config(args)
    check_plan(args)
    check_memory(args)
    check_checkpoint(args.ply)
    if args.images is not None:
        check_scene(args.images)
    outputs, page = Outputs.of(args.ply, args.out), list[Path]()
    if args.report:
        page = page_files(outputs.ply.with_suffix(".html"), ["rendering", "adapting"])
    outputs.check([args.ply], args.images, page)


def check_plan(args: Namespace) -> None:
    if both := sorted(set(args.keep_in) & set(args.leave_out)):
        raise ClodError(f"--with and --without both name {', '.join(both)}; give each to one of them")


def check_memory(args: Namespace) -> None:
    if args.memory is not None:
        parse_size(args.memory)
        if launched().size > 1:
            raise ClodError(
                "--memory is for one process: leave out torchrun, and give jobs of their own each a --block"
            )
    if args.block is None:
        return
    if args.memory is None:
        raise ClodError("--block is of a run in blocks, which --memory makes; give it too")
    if args.block != "start" and not (args.block.isascii() and args.block.isdigit() and int(args.block) >= 1):
        raise ClodError(f"--block is {args.block!r}; give start, or the number of a block, from 1")


ADAPT = Command(
    module="adapt.run",
    summary="Give a trained 3D Gaussian splat a quality dial.",
    description="""\
Give a trained 3D Gaussian splat a quality dial: one file for every budget.

Learns one number per Gaussian, sigma_d, with which a renderer fades detail out
smoothly with distance, and tunes the rest lightly. The dial s is set when
rendering: 1 is full quality, at s roughly s^-1.5 of the Gaussians are drawn.
""",
    usage="PLY [--images DIR] [--max-sv S] [--out OUT.ply] [options]",
    epilog=f"""\
outputs, side by side; a file of that name is replaced:
  OUT.ply          the splat with one more property, sigma_d
  OUT.safetensors  the adapter: only what changed; "clod-adapt apply" makes
                   OUT.ply again from it and the checkpoint
  OUT.json         the report: settings, machine, times, and per dial value the
                   quality on held-out photographs (every 8th by name)
with --report, which needs pip install 'clod-adapter[plots]':
  OUT.html         one self-contained page: a view under a slider, error against
                   the time of a frame and against seconds of training, all rows
  OUT_rendering.png, OUT_adapting.png  its charts
The PLY's header and the adapter hold the report's rows too: dial value, count,
PSNR, SSIM and frame time, from which --psnr-drop and --fps find a dial value
elsewhere. The same seed gives the same Gaussians, bit for bit; the frame times
in the calibration are those of the run.

without --images cameras are placed where the checkpoint looks photographed, and
the pictures are its own, at full detail: it is its own teacher. The numbers are
then against the checkpoint, on placed views held out. With the photographs the
result is better; give them where there are any.

{PLAN}
Before training eight of the photographs are compared with what the checkpoint
shows there. Where that is worse than their own mean colours, or another frame
fits clearly better, it stops, with what was found: other axes, scale or offset,
gsplat's or nerfstudio's normalised frame, a white background.
--misaligned-ok goes on with a warning.

While training its state is saved in OUT.resume.safetensors, after the first
step and then now and then, for at most 2 % of the time. After a crash, a kill,
a full disk or Ctrl-C the same command with --resume goes on from there, and
ends with the very Gaussians, bit for bit, that it would have ended with
undisturbed (on as many threads). Without such a file it starts from the
beginning, and says so; the finished run removes it. No file has its final name
before it is whole.

--memory 8GB plans what every phase takes, prints it, and adapts in blocks what
does not fit: blocks of the scene, each with the views that see it, in two
passes. Blocks can be jobs: with --block start, and then --block 1 and so on
(once for each pass), in any order; the same command without --block does what
is missing and writes the outputs, the same ones. Killed, it is repeated.

torchrun starts several processes, on one machine or many, which train together:
each takes its part of a step's views, one by default. The outcome is that of
one process with the same --batch, but for rounding. docs/many_processes.md.

Ctrl-C, or SIGTERM, while training stops after the step under way and writes the
state for --resume and what was learned so far (exit code 0, "interrupted": true
in the report); once more aborts, and the state last saved stays. While the
result is written it is finished first; while it is measured the rest is
skipped. Before training nothing is written. A background job of a
script ignores Ctrl-C; SIGTERM stops it.

The state is also saved where training ends, so that no error after it loses
what was learned; where that cannot be beside the output, it is in the folder
for temporary files, and stderr says what to do with it.

exit codes: 0 written; 1 a loss that is not finite ended training early (what
was learned before is written), or a fault of this program (a traceback, and
where to report it); 2 bad input or a full disk, one line on stderr and no
output written; 130 interrupted with nothing to write, or aborted

examples:
  clod-adapt garden.ply --images garden --max-sv 5
  clod-adapt garden.ply --images garden --time-budget 120 --out out/dial.ply
  clod-adapt garden.ply --images garden --quiet --json > report.json
  clod-adapt garden.ply --max-sv 5
  torchrun --nproc-per-node 8 -m clod_adapter garden.ply --images garden
""",
    add_arguments=adapt_options,
    check=check_adapt,
)
