"""Options that several commands have."""

from __future__ import annotations

from argparse import ArgumentParser

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


def add_images(parser: ArgumentParser) -> None:
    scene = "the scene: photographs and their COLMAP model or transforms.json"
    parser.add_argument("--images", metavar="DIR", required=True, help=scene)
