"""Plain files from adapted ones: one dial value, written into the opacities for good."""

from __future__ import annotations

import torch

from clod_adapter.adapter import detach
from clod_adapter.attenuation import attenuate
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians

# Fully opaque, as a finite logit: its sigmoid is 1 in float32. Some readers do not take +inf.
OPAQUE = 20.0


@torch.no_grad()
def bake(gaussians: Gaussians, virtual_scale: float) -> Gaussians:
    """The Gaussians that one dial value keeps at the normalised distance 1, faded as they are there, without a dial.

    ``logit' = log o - log(1 - o)`` with ``o`` the opacity that is drawn (``attenuation.attenuate``) at d' = 1.
    Lossy: the result has neither the dial nor the other Gaussians, and is what a renderer of the adapted file shows
    only for what is at that distance, ``scene_distance`` with the default normaliser. Nearer Gaussians come out
    fainter than they should be, or are missing; farther ones stronger. Where the dial does nothing the logits are as
    they were.

    Args:
        gaussians: with a dial.
        virtual_scale: the dial s >= 1; ``budget.dial_for(gaussians, keep=n)`` gives the one that keeps n here.

    Raises:
        ClodError: no dial, a dial value below 1 or not finite, or one that keeps no Gaussian.
    """
    if gaussians.sigma_d is None or gaussians.attenuation is None:
        raise ClodError("the Gaussians have no sigma_d, so there is no dial value to bake")
    logits = gaussians.opacity_logits
    faded = attenuate(logits, gaussians.sigma_d, torch.ones_like(logits), virtual_scale, gaussians.attenuation)
    if not faded.keep.any():
        raise ClodError(f"no Gaussian is kept at s = {virtual_scale:g} and the normalised distance 1; bake a smaller s")
    # From log a'', and by expm1 and not 1 - o, which cancels where o is near 1; the cut's part of it is 1 for most.
    drawn = faded.log_opacities + (faded.drawn / faded.opacities).log()
    baked = drawn - torch.log(-torch.expm1(drawn))
    baked = torch.where(drawn == torch.nn.functional.logsigmoid(logits), logits, baked)
    plain = detach(gaussians.replace(opacity_logits=baked.to(logits).clamp(max=OPAQUE)))
    return plain.select(faded.keep)
