"""Plain files from adapted ones: one dial value, written into the opacities for good; and rows in the dial's order."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from clod_adapter.adapter import detach
from clod_adapter.attenuation import attenuate, normalized_distances
from clod_adapter.cameras import Camera
from clod_adapter.errors import ClodError
from clod_adapter.extinction import extinction_scale
from clod_adapter.gaussians import OPAQUE, Gaussians
from clod_adapter.units import nominal_distance


@torch.no_grad()
def bake(gaussians: Gaussians, virtual_scale: float, camera: Camera | None = None) -> Gaussians:
    """The Gaussians that one dial value keeps as seen from one place, faded as they are there, without a dial.

    ``logit' = log o - log(1 - o)`` with ``o`` the opacity that is drawn (``attenuation.attenuate``) at the nominal
    distance (``units.nominal_distance``), or at the d' that ``camera`` has. Lossy: the result has neither the dial nor
    the other Gaussians, and is what a renderer of the adapted file shows only for what is at that distance,
    ``reference_distance`` with the default normaliser, or from where the camera is. Nearer Gaussians come out fainter
    than they should be, or are missing; farther ones stronger.
    Where the dial does nothing the logits are as they were, but for +inf, which becomes ``OPAQUE``.

    Args:
        gaussians: with a dial.
        virtual_scale: the dial s >= 1; ``budget.dial_for(gaussians, keep=n)`` gives the one that keeps n here, with
            ``cameras=[camera]`` the one that does so for the camera.
        camera: where the result is exact; which way it looks matters for the normalisers ``quantile`` and ``max`` only.

    Raises:
        ClodError: no dial, a dial value below 1 or not finite, or one that keeps no Gaussian.
    """
    if gaussians.sigma_d is None or gaussians.attenuation is None:
        raise ClodError("the Gaussians have no sigma_d, so there is no dial value to bake")
    logits = gaussians.opacity_logits
    distances = _distances(gaussians, camera)
    faded = attenuate(logits, gaussians.sigma_d, distances, virtual_scale, gaussians.attenuation)
    if not faded.keep.any():
        where = "at the scene's typical distance" if camera is None else f"from the camera {camera.name!r}"
        raise ClodError(f"no Gaussian is kept at s = {virtual_scale:g} {where}; bake a smaller s")
    # From log a'', and by expm1 and not 1 - o, which cancels where o is near 1; the cut's part of it is 1 for most.
    drawn = faded.log_opacities + (faded.drawn / faded.opacities).log()
    baked = (drawn - torch.log(-torch.expm1(drawn))).clamp(max=OPAQUE)
    same = (drawn == torch.nn.functional.logsigmoid(logits)) & logits.isfinite()
    plain = detach(gaussians.replace(opacity_logits=torch.where(same, logits, baked.to(logits))))
    return plain.select(faded.keep)


@torch.no_grad()
def order_by_extinction(gaussians: Gaussians, cameras: Sequence[Camera] = ()) -> Tensor:
    """``[N]`` int64, the rows by falling extinction scale s* at the nominal distance, or as cameras have it.

    Ties stay in their order.

    For renderers that draw a prefix of a file: with ``gaussians.select(rows)`` the first n are those that the dial
    which keeps n keeps there (``extinction.extinction_scale``), up to the rounding of s*. Over several cameras it is
    the mean of log s* that falls, which makes better prefixes where distances differ much (benchmarks/prefix.py).

    Raises:
        ClodError: no dial.
    """
    if gaussians.sigma_d is None or gaussians.attenuation is None:
        raise ClodError("the Gaussians have no sigma_d, so no order in which they leave")
    logits, sigma_d, config = gaussians.opacity_logits, gaussians.sigma_d, gaussians.attenuation
    total = torch.zeros_like(logits, dtype=torch.float64)
    for camera in cameras or (None,):
        total += extinction_scale(logits, sigma_d, _distances(gaussians, camera), config).double().log()
    return total.argsort(descending=True, stable=True)


def _distances(gaussians: Gaussians, camera: Camera | None) -> Tensor:
    """``[N]`` d' of the equation: ``units.nominal_distance`` without a camera."""
    assert gaussians.attenuation is not None
    if camera is None:
        nominal = nominal_distance(gaussians.means, gaussians.attenuation)
        return torch.full_like(gaussians.opacity_logits, nominal)
    return normalized_distances(gaussians.means, camera, gaussians.attenuation)
