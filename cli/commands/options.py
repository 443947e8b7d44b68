"""Options that several commands share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clod_adapter.config import FILTERS

if TYPE_CHECKING:
    from argparse import _ActionsContainer  # a parser or one of its groups


def add_activated(options: _ActionsContainer) -> None:
    options.add_argument(
        "--activated", choices=["none", "opacity", "scales", "both"],
        help="values that the file stores after activation (sigmoid of opacities, exp of scales)",
    )  # fmt: skip


def add_antialiasing(options: _ActionsContainer, photographs: bool = True) -> None:
    otherwise = "by the photographs" if photographs else "off"
    options.add_argument(
        "--antialiasing", choices=["auto", *FILTERS], default="auto",
        help="screen-space filter of the training: off, on (gsplat's rasterize_mode antialiased, Inria's "
        f"--antialiasing), mip (Mip-Splatting), or auto: as the file says, else {otherwise} (default: auto)",
    )  # fmt: skip


def add_device(options: _ActionsContainer, what: str) -> None:
    usual = "auto: the NVIDIA GPU if gsplat works on it, else the CPU (default: auto)"
    options.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto", help=f"where to {what}; {usual}")


def add_images(options: _ActionsContainer) -> None:
    scene = "scene folder: photographs, and a COLMAP model or transforms.json"
    options.add_argument("--images", metavar="DIR", required=True, help=scene)


def add_misaligned_ok(options: _ActionsContainer) -> None:
    options.add_argument(
        "--misaligned-ok", action="store_true", help="train even if the checkpoint does not match the photographs"
    )
