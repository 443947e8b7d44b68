"""The options of each command."""

from __future__ import annotations

from argparse import ArgumentParser

from clod_adapter.cli.dials import add_dial_options
from clod_adapter.cli.help_plan import add_plan_options
from clod_adapter.cli.settings import add_settings
from clod_adapter.config import FILTERS


def add_activated(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--activated", choices=["none", "opacity", "scales", "both"],
        help="what a checkpoint stores activated: opacities as such, scales as lengths; asked for where it looks so",
    )  # fmt: skip


def add_antialiasing(parser: ArgumentParser, photographs: bool = True) -> None:
    otherwise = "the photographs, where the file does not say" if photographs else "else off"
    parser.add_argument(
        "--antialiasing", choices=["auto", *FILTERS], default="auto",
        help="what a checkpoint was trained with: off; on (gsplat's rasterize_mode antialiased, Inria's "
        f"--antialiasing); mip (Mip-Splatting's); auto asks the file and {otherwise} (default: auto)",
    )  # fmt: skip


def add_device(parser: ArgumentParser, what: str) -> None:
    usual = "auto is the NVIDIA GPU where gsplat draws on one, else the CPU (default: auto)"
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto", help=f"where to {what}; {usual}")


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
        "--memory", metavar="SIZE", help="stay below this, as in 8GB: where the whole does not fit, train it in chunks"
    )
    parser.add_argument(
        "--chunk", metavar="N", help="do only the start, or only chunk N, of a run with --memory; without it the same "
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


def _add_images(parser: ArgumentParser) -> None:
    scene = "the scene: photographs and their COLMAP model or transforms.json"
    parser.add_argument("--images", metavar="DIR", required=True, help=scene)


def evaluate_options(parser: ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL.ply", help="an adapted file, or a plain one as the baseline")
    _add_images(parser)
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


def render_options(parser: ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL.ply", help="an adapted file, or a plain one")
    _add_images(parser)
    parser.add_argument("-o", "--out", metavar="FOLDER", required=True, help="where the pictures go; made if missing")
    add_dial_options(
        parser, "dial values (default: 1); several are put side by side", "(mean over the pictures)", several=True,
        required=False,
    )  # fmt: skip
    parser.add_argument(
        "--views", metavar="NAME", nargs="+", default=["held-out"],
        help="photographs whose cameras to render, by name, or all, or held-out (default)",
    )  # fmt: skip
    parser.add_argument("--beside", action="store_true", help="put the photograph left of the renderings")
    add_device(parser, "render")
    add_activated(parser)
    add_antialiasing(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")


def apply_options(parser: ArgumentParser) -> None:
    parser.add_argument("base", metavar="BASE.ply", help="the checkpoint that was adapted")
    parser.add_argument("adapter", metavar="ADAPTER.safetensors", help="what clod-adapt wrote beside its PLY")
    parser.add_argument("-o", "--out", metavar="OUT.ply", required=True, help="what to write; replaced if it exists")
    add_activated(parser)
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")


def robustness_options(parser: ArgumentParser) -> None:
    parser.add_argument("ply", metavar="PLY", nargs="+", help="checkpoints of one scene; they are never modified")
    _add_images(parser)
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


def demo_options(parser: ArgumentParser) -> None:
    parser.add_argument("-o", "--out", metavar="DIR", default="demo", help="where everything goes (default: demo)")
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")
