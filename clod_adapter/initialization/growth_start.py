"""Growth without training: exponents with which the Gaussians that remain cover the area of those that are culled."""

from __future__ import annotations

import torch
from torch import Tensor

from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.extinction import extinction_scale
from clod_adapter.equation.growth import growth_distance, growth_factors
from clod_adapter.gaussians import Gaussians

DIALS = 24  # dial values of the fit, evenly spaced in log s
MOST = 1.0  # of the exponents before SHARE
SHARE = 0.65  # of the fitted exponents that is used; 0.5 and 0.8 are no better at any share


@torch.no_grad()
def initial_growth(gaussians: Gaussians, substitutes: Tensor, distances: Tensor) -> Tensor:
    """``[N]`` the exponents h, in [0, MOST SHARE], from the pruning order; no photograph is needed.

    At a dial value s a Gaussian stands for itself and for all that were removed before s in whose favour it, or their
    substitute, was kept. Areas A are opacity times the product of the two larger scales, as merging tools weigh them.
    h is the least-squares fit of ``h log m(s) = log(sum of A / own A) / 2`` over the dial values at which it is kept,
    times SHARE.

    Args:
        gaussians: with a sigma_d; its settings have max_sv.
        substitutes: ``[N]`` int64, from ``pruning_order``.
        distances: ``[N]`` normalised distances at which sigma_d follows the pruning order.
    """
    config: AttenuationConfig | None = gaussians.attenuation
    assert config is not None and gaussians.sigma_d is not None
    scales = gaussians.log_scales.double().sort(1).values
    area = gaussians.opacities.double() * (scales[:, 1] + scales[:, 2]).exp()
    extinction = extinction_scale(gaussians.opacity_logits, gaussians.sigma_d, distances, config)
    total, weight = torch.zeros_like(area), torch.zeros_like(area)
    for k in range(1, DIALS):
        s = config.max_sv ** (k / (DIALS - 1))
        kept = extinction > s
        stands_for = torch.zeros_like(area).index_add_(0, _kept_substitutes(kept, substitutes), area)
        wanted = (stands_for / area).clamp(min=1).log().div_(2).nan_to_num_(0.0, 0.0)
        available = growth_factors(torch.ones_like(distances), distances, s, growth_distance(config)).double().log()
        total += kept * wanted * available
        weight += kept * available.square()
    exponents = (total / weight.clamp(min=1e-12)).clamp_(0, MOST)
    return exponents.mul_(SHARE).to(gaussians.opacity_logits)


def _kept_substitutes(kept: Tensor, substitutes: Tensor) -> Tensor:
    """``[N]`` the first kept one of each Gaussian, its substitute, the substitute of that and so on."""
    own = torch.arange(len(kept), device=kept.device)
    found = torch.where(kept, own, substitutes)
    for _ in range(len(kept).bit_length()):  # each time chains are twice as long; there may be circles of removed ones
        if torch.equal(further := found[found], found):
            break
        found = further
    return found
