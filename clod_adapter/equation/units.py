"""The unit of sigma_d: world units in results and files, the reference distance of the scene while
it is trained.

In world units D is 1; in training sigma_d is near 1.
"""

from dataclasses import replace

import torch
from torch import Tensor

from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.gaussians import Gaussians

# Quantile of the distances from the centre of a scene that estimates how far its photographs look.
# In three captures it is 0.28, 1.03 and 1.09 of the mean 0.95 quantile of their distances (few near
# one another, two from all sides).
TYPICAL = 0.9


@torch.no_grad()
def with_distance(gaussians: Gaussians, distance: float) -> Gaussians:
    """The same dial with ``scene_distance`` D' = ``distance``, world units, > 0; Gaussians without
    a dial unchanged.

    ``sigma_d`` is multiplied by D / D', except SIGMA_MAX and, in the paper's form, which does not
    use D, all. The result's ``reference_distance`` is ``known_distance`` of the input. Where that
    is unknown and there is a ``growth_d``, it is D: growth begins there.
    """
    config = gaussians.attenuation
    sigma = gaussians.sigma_d
    if config is None or sigma is None or config.scene_distance == distance:
        return gaussians
    reference = known_distance(config)
    if gaussians.growth_d is not None:
        reference = reference or config.scene_distance
    if config.form == "ours":
        scaled = (
            (sigma.double() * (config.scene_distance / distance))
            .clamp(max=SIGMA_MAX)
            .to(sigma.dtype)
        )
        sigma = torch.where(sigma >= SIGMA_MAX, sigma, scaled)
    changed = replace(config, scene_distance=distance, reference_distance=reference)
    return gaussians.replace(sigma_d=sigma, attenuation=changed)


def in_world_units(gaussians: Gaussians) -> Gaussians:
    """The same dial with ``scene_distance`` 1, as results and files have it."""
    return with_distance(gaussians, 1.0)


def known_distance(config: AttenuationConfig) -> float:
    """World units: ``reference_distance``, else a D other than 1, as in training; 0 where both are
    unknown.
    """
    return config.reference_distance or (
        config.scene_distance if config.scene_distance != 1 else 0.0
    )


def nominal_distance(means: Tensor, config: AttenuationConfig) -> float:
    """The normalised distance d > 0 of a viewpoint of a scene without cameras: known or estimated;
    the paper's is 1.
    """
    if config.form == "paper":
        return 1.0
    return (known_distance(config) or estimated_distance(means)) / config.scene_distance


@torch.no_grad()
def estimated_distance(means: Tensor) -> float:
    """World units, > 0: the TYPICAL quantile of the distances from the median; 1 for a scene
    without extent.
    """
    if len(means) == 0:
        return 1.0
    distances = (means - means.median(0).values).double().norm(dim=1)
    rank = min(max(round(TYPICAL * len(distances)), 1), len(distances))
    return float(distances.kthvalue(rank).values) or 1.0
