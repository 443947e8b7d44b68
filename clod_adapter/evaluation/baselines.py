"""What an adapted file is compared with: other files at the same counts, and its base cut down by rank."""

from collections.abc import Sequence
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter.cameras import Camera, View, spread
from clod_adapter.equation.attenuation import dial
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.budget import dial_for
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, removal_error
from clod_adapter.progress import Listener


@torch.no_grad()
def mean_kept(gaussians: Gaussians, cameras: Sequence[Camera], virtual_scale: float) -> float:
    """Gaussians kept at a dial value, mean over the cameras; without rendering."""
    return fmean(int(dial(gaussians, camera, virtual_scale).keep.sum()) for camera in cameras)


def matching_dial(gaussians: Gaussians, cameras: Sequence[Camera], count: float) -> float:
    """The dial value that keeps ``count`` on average, clamped to [1, max_sv]; 1 without a dial."""
    if gaussians.attenuation is None:
        return 1.0
    try:
        return dial_for(gaussians, keep=max(count, 1), cameras=cameras).virtual_scale
    except ClodError:  # out of reach
        return gaussians.attenuation.max_sv


def rankings(base: Gaussians, views: Sequence[View], progress: Listener | None = None) -> dict[str, Tensor]:
    """``[N]`` indices of the Gaussians of an unadapted base, most important first, by two rankings.

    ``removal error`` is the image error of removing the Gaussian alone, in up to 64 evenly spread training views.
    """
    removal = removal_error(base, spread(views, MOST_VIEWS), progress=progress)
    return {"opacity": by_opacity(base), "removal error": removal.argsort(descending=True, stable=True)}


def by_opacity(gaussians: Gaussians) -> Tensor:
    """``[N]`` indices, the most opaque first; stable."""
    return gaussians.opacity_logits.argsort(descending=True, stable=True)
