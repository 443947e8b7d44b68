"""The unit of sigma_d: world units in results and files, the reference distance of the scene while it is trained.

The attenuation factor, ``exp(-(d / D s)^2 / (2 sigma^2 + eps))``, is the same for another D' where
``D'^2 (2 sigma'^2 + eps) = D^2 (2 sigma^2 + eps)``. In world units D is 1; in training sigma_d is near 1.
"""

from dataclasses import replace

import torch
from torch import Tensor

from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.equation.autograd import twice_variance
from clod_adapter.gaussians import Gaussians

# Quantile of the distances from the centre of a scene that estimates how far its photographs look. In three captures it
# is 0.28, 1.03 and 1.09 of the mean 0.95 quantile of their distances (few near one another, two from all sides).
REACH = 0.9
# Down to this ratio eps = 1e-8 of the new unit hides only sigma_d below 0.007 of the old one.
SMALL = 0.01


@torch.no_grad()
def with_distance(gaussians: Gaussians, distance: float) -> Gaussians:
    """The same dial with ``scene_distance`` D' = ``distance``, world units, > 0; Gaussians without a dial unchanged.

    ``sigma'^2 = ((D / D')^2 (2 sigma^2 + eps) - eps) / 2``, in float64, at least 0. Values of 0 or below and SIGMA_MAX
    stay. Where D / D' is below SMALL, eps would hide sigma': there it becomes ``(D / D')^2 eps``, to six
    digits; where D / D' is above 1 / SMALL, eps grows back so, to four digits, but not beyond the default. The
    normaliser ``max`` does not use D, and keeps its sigma_d. The result's ``reference_distance`` is
    ``known_distance`` of the input. Where that is unknown and there is a ``growth_d``, it is D: growth begins there.
    """
    config, sigma = gaussians.attenuation, gaussians.sigma_d
    if config is None or sigma is None or config.scene_distance == distance:
        return gaussians
    known = known_distance(config)
    if gaussians.growth_d is not None:
        known = known or config.scene_distance
    changed = replace(config, scene_distance=distance, reference_distance=known)
    if config.normalizer == "scene":
        ratio = config.scene_distance / distance
        if ratio < SMALL:
            changed = replace(changed, eps=float(f"{config.eps * ratio**2:.6g}"))
        elif ratio > 1 / SMALL:  # else each round trip would end with a smaller eps
            usual = AttenuationConfig().eps
            changed = replace(changed, eps=max(config.eps, float(f"{min(config.eps * ratio**2, usual):.4g}")))
        scaled = twice_variance(sigma, config.eps).mul_(ratio**2).sub_(changed.eps).div_(2).clamp_(min=0).sqrt_()
        unscaled = (sigma <= 0) | (sigma >= SIGMA_MAX)
        sigma = torch.where(unscaled, sigma, scaled.clamp_(max=SIGMA_MAX).to(sigma.dtype))
    return gaussians.replace(sigma_d=sigma, attenuation=changed)


def in_world_units(gaussians: Gaussians) -> Gaussians:
    """The same dial with ``scene_distance`` 1, as results and files have it."""
    return with_distance(gaussians, 1.0)


def known_distance(config: AttenuationConfig) -> float:
    """World units: ``reference_distance``, else a D other than 1, as older versions wrote; 0 where both are unknown."""
    return config.reference_distance or (config.scene_distance if config.scene_distance != 1 else 0.0)


def nominal_distance(means: Tensor, config: AttenuationConfig) -> float:
    """The normalised distance d > 0 of a viewpoint of a scene without cameras: known or estimated; 1 for ``max``."""
    if config.normalizer != "scene":
        return 1.0
    return (known_distance(config) or estimated_distance(means)) / config.scene_distance


@torch.no_grad()
def estimated_distance(means: Tensor) -> float:
    """World units, > 0: the REACH quantile of the distances from the median; 1 for a scene without extent."""
    if len(means) == 0:
        return 1.0
    distances = (means - means.median(0).values).double().norm(dim=1)
    rank = min(max(round(REACH * len(distances)), 1), len(distances))
    return float(distances.kthvalue(rank).values) or 1.0
