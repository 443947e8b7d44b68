"""Plain files from adapted ones: one dial value, written into the opacities for good; and rows in the dial's order."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from clod_adapter.adapter import detach
from clod_adapter.attenuation import Attenuated, attenuate
from clod_adapter.calibration import Viewpoint
from clod_adapter.cameras import Camera
from clod_adapter.errors import ClodError
from clod_adapter.extinction import extinction_scale
from clod_adapter.gaussians import OPAQUE, Gaussians
from clod_adapter.viewpoints import typical_distance

# The power of the dial value whose opacities a plain file has. Of 0, 0.5, 0.75 and 1 on held-out photographs the one
# that was never below the dial by more than 0.05 dB at equal counts, and up to 0.6 dB above it.
FADED = 0.75


@torch.no_grad()
def bake(
    gaussians: Gaussians,
    virtual_scale: float,
    camera: Camera | None = None,
    *,
    cameras: Sequence[Camera | Viewpoint] = (),
) -> Gaussians:
    """The Gaussians that one dial value keeps, with opacities for good and without a dial.

    ``logit' = log o - log(1 - o)`` with ``o`` the opacity that is drawn (``attenuation.attenuate``). Lossy: the result
    has neither the dial nor the other Gaussians.

    For one ``camera`` the picture from there is the dial's: ``o`` is what is drawn at its distances.

    For ``cameras`` each Gaussian has one distance (``viewpoints.typical_distance``). There those are kept that the
    dial keeps at s, with the opacities that are drawn at ``s^FADED``: the dial fades what is about to leave, so that
    nothing pops, for which a plain file has no use (benchmarks/bake.py).

    Where the dial does nothing the logits are as they were, but for +inf, which becomes ``OPAQUE``.

    Args:
        gaussians: with a dial.
        virtual_scale: the dial s >= 1; ``budget.dial_for(gaussians, keep=n, cameras=cameras, baked=True)`` gives the
            one that keeps n here.
        camera: one, from where the result is exact; which way it looks matters for the normalisers ``quantile`` and
            ``max`` only.
        cameras: those that the result is for, in place of ``camera``: the training cameras, or some of them, as
            ``load(path).viewpoints`` are.

    Raises:
        ClodError: no dial, not one of camera and cameras, a dial value below 1 or not finite, or one that keeps no
            Gaussian.
    """
    if gaussians.sigma_d is None or gaussians.attenuation is None:
        raise ClodError("the Gaussians have no sigma_d, so there is no dial value to bake")
    if (camera is None) == (not cameras):
        raise ClodError("bake needs either camera or cameras; load(path).viewpoints are those stored with the file")
    logits, sigma_d, config = gaussians.opacity_logits, gaussians.sigma_d, gaussians.attenuation
    distances = typical_distance(gaussians.means, [camera] if camera else cameras, config)
    faded = attenuate(logits, sigma_d, distances, virtual_scale, config)
    if not faded.keep.any():
        raise ClodError(f"no Gaussian is kept at s = {virtual_scale:g}; bake a smaller s")
    shown = faded if camera else attenuate(logits, sigma_d, distances, virtual_scale**FADED, config)
    return detach(gaussians.replace(opacity_logits=_logits_drawn(shown, logits))).select(faded.keep)


@torch.no_grad()
def order_by_extinction(gaussians: Gaussians, cameras: Sequence[Camera | Viewpoint]) -> Tensor:
    """``[N]`` int64, the rows by falling extinction scale s*, for renderers that draw a prefix; ties as they were.

    With ``gaussians.select(rows)`` the first n are those that ``bake`` keeps for the cameras where it keeps n, up to
    the rounding of s* (``extinction.extinction_scale``).

    Raises:
        ClodError: no dial, or no camera.
    """
    if gaussians.sigma_d is None or gaussians.attenuation is None:
        raise ClodError("the Gaussians have no sigma_d, so no order in which they leave")
    distances = typical_distance(gaussians.means, cameras, gaussians.attenuation)
    scales = extinction_scale(gaussians.opacity_logits, gaussians.sigma_d, distances, gaussians.attenuation)
    return scales.argsort(descending=True, stable=True)


def _logits_drawn(shown: Attenuated, logits: Tensor) -> Tensor:
    """``[N]`` the logits of what is drawn; ``logits`` themselves where they are that."""
    # From log a'', and by expm1 and not 1 - o, which cancels where o is near 1; the cut's part of it is 1 for most.
    drawn = shown.log_opacities + (shown.drawn / shown.opacities).log()
    baked = (drawn - torch.log(-torch.expm1(drawn))).clamp(max=OPAQUE)
    same = (drawn == torch.nn.functional.logsigmoid(logits)) & logits.isfinite()
    return torch.where(same, logits, baked.to(logits))
