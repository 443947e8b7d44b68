"""What each Gaussian contributes to the training views, and the sigma_d that follows from its rank."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from clod_adapter.attenuation import normalized_distances, sigma_for_extinction
from clod_adapter.cameras import View
from clod_adapter.config import AttenuationConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.render import splat


def removal_error(
    gaussians: Gaussians, views: Sequence[View], *, seed: int = 0, progress: Callable[[int], None] | None = None
) -> Tensor:
    """``[N]`` estimate of the squared picture error that removing each Gaussian alone would cause.

    To first order removing Gaussian i changes pixel p by ``a_i dC_p/da_i``. Its sum of squares over
    the pixels, mean over the views, is estimated without a bias by one backward pass a view: with random signs
    z, ``E[(sum_p z_p dC_p/da_i)^2] = sum_p (dC_p/da_i)^2`` (Hutchinson's estimator on the
    Gauss-Newton matrix). Works with every differentiable rasterizer.

    Args:
        progress: called with the number of views done after each.
    """
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros(len(gaussians))
    for done, view in enumerate(views, 1):
        opacities = gaussians.opacities.detach().requires_grad_()
        image, _ = splat(gaussians, opacities, view.camera)
        signs = torch.randint(0, 2, image.shape, generator=generator).to(image) * 2 - 1
        (gradient,) = torch.autograd.grad(image, opacities, signs)
        total += (gradient * opacities.detach()).square()
        if progress:
            progress(done)
    return total / max(len(views), 1)


def typical_distance(gaussians: Gaussians, views: Sequence[View], config: AttenuationConfig) -> Tensor:
    """``[N]`` the geometric mean over views of the normalised distance."""
    logs = torch.zeros(len(gaussians))
    for view in views:
        logs += normalized_distances(gaussians.means, view.camera, config).clamp(min=1e-6).log()
    return (logs / max(len(views), 1)).exp()


def sigma_from_importance(
    gaussians: Gaussians,
    importance: Tensor,
    distances: Tensor,
    config: AttenuationConfig,
    *,
    share: float,
    exponent: float,
) -> Tensor:
    """``[N]`` sigma_d with which the share kept follows the count law from the start, before any training.

    Gaussians are ranked by importance. The one at rank fraction r (0 the most important) leaves
    where the law ``1 / (s^p + (1/share - 1) s^-p)`` falls to r: ``share`` at s = 1, and soon the
    paper's target ``s^-p`` (section 3.3, p = 1.5). Ranks beyond ``share`` leave before s = 1.

    Args:
        importance: ``[N]``, larger stays longer.
        distances: ``[N]`` normalised distance at which the law is to hold.
        share: of all Gaussians, kept at s = 1; in (0.5, 1].
    """
    rank = torch.empty(len(importance))
    rank[importance.argsort(descending=True, stable=True)] = (torch.arange(len(importance)) + 0.5) / len(importance)
    power = (1 / rank + (rank**-2 - 4 * (1 / share - 1)).clamp(min=0).sqrt()) / 2
    extinction = torch.where(rank <= share, power ** (1 / exponent), share / rank)
    return sigma_for_extinction(gaussians.opacity_logits, distances, extinction, config)
