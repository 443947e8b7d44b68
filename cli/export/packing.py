"""Packing with splat-transform: a progress bar, and the loss of a packed page."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory

import numpy as np
import torch

from clod_adapter.cameras import Camera
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import load
from clod_adapter.metrics import psnr
from clod_adapter.render import render
from clod_adapter.training.camera_placement import place_cameras
from clod_adapter.viewer.sog import PackedSplat

from ..shared.console import Console, Meter
from ..shared.kernels import prepare_kernels

# Seconds of a run: to start, and per Gaussian of SH degree 2 without a GPU. With one, or without SH, it ends earlier.
START, EACH = 1.0, 0.002
VIEWS = 4  # on which the loss is measured


@contextmanager
def packing_bar(console: Console, count: int) -> Iterator[Callable[[float], None]]:
    """A bar by the expected time of splat-transform, which reports no progress; yields a function of the seconds."""
    with closing(Meter(console, "splat-transform", slow=True)) as meter:
        done = 0.0

        def show(seconds: float) -> None:
            nonlocal done
            done = max(done, min(seconds / (START + EACH * count), 0.99))  # of two runs the second starts at 0 again
            meter.update(done, f"{count:,} Gaussians, estimated")

        yield show


@torch.no_grad()
def packing_loss(packed: PackedSplat, exact: Gaussians, cameras: list[Camera], console: Console) -> float:
    """PSNR of renders of a packed page at s = 1 against those of the exact one, in 8 bits, dB.

    Args:
        exact: what was packed.
        cameras: at most four of them are rendered, evenly spread; placed ones without any.
    """
    shown = unpacked(packed, exact)
    prepare_kernels(console, exact.means.device, training=False)
    seen = cameras[:: -(-len(cameras) // VIEWS)] if cameras else place_cameras(exact, views=VIEWS)
    with console.status("measuring the loss of packing ..."):
        return fmean(psnr(render(shown, each).image, render(exact, each).pixels) for each in seen)


def unpacked(packed: PackedSplat, exact: Gaussians) -> Gaussians:
    """The Gaussians as the page decodes them."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "packed.sog"
        path.write_bytes(packed.sog)
        found = load(path).gaussians.to(exact.means.device)
    columns = {name: gzip.decompress(data) for name, data in packed.columns.items()}
    dial = {
        name: torch.from_numpy(np.frombuffer(data, "<f4").copy()).to(found.means.device)
        for name, data in columns.items()
    }
    return found.replace(**dial, attenuation=exact.attenuation, screen_filter=exact.screen_filter)
