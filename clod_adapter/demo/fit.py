"""Trains the base checkpoint of the demo from its point cloud, with this package's rasterizer."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from clod_adapter.adapter import detach, with_dial
from clod_adapter.cameras import Scene
from clod_adapter.config import SH_COUNTS, AdaptConfig
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.progress import Listener, Stopped
from clod_adapter.training.loop import adapt


def fit_base(
    points: np.ndarray, colors: np.ndarray, scene: Scene, *, iters: int, progress: Listener | None = None
) -> Gaussians:
    """Trains one Gaussian per point at s = 1: ``adapt`` without fading and with 3DGS's learning rates.

    Args:
        points: ``[N, 3]`` world units; colors: ``[N, 3]`` uint8.
        iters: training steps.

    Raises:
        Stopped: ``progress`` returned False, or Ctrl-C ended training.
    """
    config = AdaptConfig(
        max_sv=1, iters=iters, lr_sigma=0, lr_means=1.6e-4, lr_quats=1e-3, lr_scales=5e-3,
        lr_opacities=5e-2, lr_sh0=2.5e-3, lr_shN=1.25e-4, lr_final=0.05, average=0.0, coarse=0.0,
    )  # fmt: skip
    initial = from_points(points, colors)
    frozen = torch.full((len(initial),), SIGMA_MAX / 10)  # no fading; SIGMA_MAX would be initialized
    adapted = adapt(with_dial(initial, frozen), scene, config, progress)
    if adapted.interrupted:
        raise Stopped(f"stopped at step {adapted.steps}")
    return detach(adapted.gaussians)


def from_points(points: np.ndarray, colors: np.ndarray) -> Gaussians:
    """3DGS's initialization: isotropic Gaussians scaled by the distance to neighbours, opacity 0.1, SH degree 3."""
    means = torch.from_numpy(points).float()
    n = len(means)
    rgb = torch.from_numpy(colors).float() / 255
    spacing = neighbour_distance(means).clamp(min=1e-4)
    return Gaussians(
        means=means, quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), log_scales=spacing.log()[:, None].repeat(1, 3),
        opacity_logits=torch.full((n,), 0.1).logit(), sh0=((rgb - 0.5) / SH_C0)[:, None],
        shN=torch.zeros(n, SH_COUNTS[3] - 1, 3),
    )  # fmt: skip


def neighbour_distance(means: Tensor) -> Tensor:
    """``[N]`` root mean square distance to the three nearest neighbours."""
    found = [torch.cdist(block, means).topk(4, largest=False).values[:, 1:] for block in means.split(1024)]
    return torch.cat(found).square().mean(1).sqrt()
