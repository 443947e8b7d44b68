"""How alike two sets of Gaussians look."""

from collections.abc import Sequence
from statistics import fmean

from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.merging import merge
from clod_adapter.losses import decibels, mean_squared_error
from clod_adapter.progress import Listener
from clod_adapter.render import render
from clod_adapter.training.far import PLACED_CONTRAST


def agreement(shown: Gaussians, exact: Gaussians, cameras: Sequence[Camera]) -> float:
    """PSNR in dB of renders of ``shown`` against those of ``exact``, at s = 1 of a dial.

    It is that of the mean squared error over all cameras: one that looks wrong counts for much.
    """
    return decibels(
        fmean(
            mean_squared_error(render(shown, each).image, render(exact, each).pixels)
            for each in cameras
        )
    )


def merged_if_nearer(
    baked: Gaussians,
    checkpoint: Gaussians,
    importance: Tensor,
    cameras: Sequence[Camera],
    progress: Listener | None = None,
) -> Gaussians | None:
    """The checkpoint merged by importance to as many as are ``baked``, if its ``agreement`` with
    the checkpoint is the larger one.
    """
    weights = importance.double() ** PLACED_CONTRAST
    merged = merge(checkpoint, len(baked), weights, progress)
    nearer = agreement(merged, checkpoint, cameras) > agreement(baked, checkpoint, cameras)
    return merged if nearer else None
