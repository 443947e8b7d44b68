"""Rounded values: a progress bar for splat-transform, and the PSNR of a page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from statistics import fmean

import torch

from clod_adapter.cameras import Camera, spread
from clod_adapter.gaussians import Gaussians
from clod_adapter.metrics import psnr
from clod_adapter.render import render
from clod_adapter.training.camera_placement import place_cameras

from ..shared.console import Console, Meter

# Seconds of a run: to start, and per Gaussian of SH degree 2 without a GPU. With one, or without SH, it ends earlier.
START, EACH = 1.0, 0.002
VIEWS = 4  # on which a page is measured


@contextmanager
def packing_bar(console: Console, count: int) -> Iterator[Callable[[float], None]]:
    """A bar by the expected time of splat-transform, which reports no progress; yields a function of the seconds."""
    with closing(Meter(console, "splat-transform", slow=True)) as meter:

        def show(seconds: float) -> None:
            meter.update(min(seconds / (START + EACH * count), 0.99), f"{count:,} Gaussians, estimated")

        yield show


@torch.no_grad()
def page_psnr(shown: Gaussians, exact: Gaussians, cameras: list[Camera], console: Console) -> tuple[float, int]:
    """PSNR of renders of a page's Gaussians at s = 1 against those of the exact ones, in 8 bits, dB; and their number.

    Args:
        cameras: at most VIEWS of them are rendered, evenly spread; placed ones without any.
    """
    seen = spread(cameras, VIEWS) if cameras else place_cameras(exact, views=VIEWS)
    with console.status("comparing with the exact values ..."):
        return fmean(psnr(render(shown, each).image, render(exact, each).pixels) for each in seen), len(seen)
