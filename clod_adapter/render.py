"""The one joint: activate, attenuate, cut, rasterize. Training, evaluation and baking all pass through it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from clod_adapter.attenuation import Attenuated, attenuate_seen
from clod_adapter.cameras import Camera
from clod_adapter.config import require
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers import Rasterizer, for_device


@dataclass(frozen=True)
class Rendering:
    """A picture and what it took.

    Attributes:
        image: ``[H, W, 3]`` float, not clamped.
        alpha: ``[H, W]`` accumulated opacity.
        kept: ``[N]`` bool, the Gaussians the dial leaves in; the rasterizer saw no others.
    """

    image: Tensor
    alpha: Tensor
    kept: Tensor

    @property
    def pixels(self) -> Tensor:
        """``[H, W, 3]`` uint8, the image as a file has it."""
        return (self.image.clamp(0, 1) * 255).round().to(torch.uint8)


def dial(gaussians: Gaussians, camera: Camera, virtual_scale: float) -> Attenuated:
    """Opacities of the Gaussians as ``camera`` sees them at one dial value (CLoD-GS Eq. 2 and its mask).

    Without a ``sigma_d`` the dial does nothing: stored opacities, all kept.

    Raises:
        ClodError: the dial is below 1 or not finite.
    """
    if gaussians.sigma_d is None or gaussians.attenuation is None:
        require(1 <= virtual_scale < float("inf"), "virtual_scale", virtual_scale, "at least 1 and finite")
        log_opacities = torch.nn.functional.logsigmoid(gaussians.opacity_logits)
        keep = torch.ones(len(gaussians), dtype=torch.bool, device=log_opacities.device)
        return Attenuated(gaussians.opacities, log_opacities, keep, gaussians.opacities)
    return attenuate_seen(
        gaussians.means, gaussians.opacity_logits, gaussians.sigma_d, camera, virtual_scale, gaussians.attenuation
    )


def splat(
    gaussians: Gaussians,
    opacities: Tensor,
    camera: Camera,
    *,
    background: Tensor | None = None,
    rasterizer: Rasterizer | None = None,
) -> tuple[Tensor, Tensor]:
    """Image ``[H, W, 3]`` and alpha ``[H, W]`` of the Gaussians with the given ``opacities [N]``, black behind.

    Raises:
        ClodError: the opacities or the background have the wrong shape.
    """
    rasterize = rasterizer or for_device(gaussians.means.device)
    behind = torch.zeros(3, device=gaussians.means.device) if background is None else background
    if behind.shape != (3,) or opacities.shape != (len(gaussians),):
        raise ClodError(
            f"background is {tuple(behind.shape)} and must be (3,), opacities {tuple(opacities.shape)} and must be "
            f"({len(gaussians)},)"
        )
    return rasterize(
        gaussians.means, gaussians.quats, gaussians.scales, opacities, gaussians.sh0, gaussians.shN, camera, behind,
        gaussians.screen_filter,
    )  # fmt: skip


def render(
    gaussians: Gaussians,
    camera: Camera,
    virtual_scale: float = 1.0,
    *,
    background: Tensor | None = None,
    rasterizer: Rasterizer | None = None,
) -> Rendering:
    """Renders at one dial value, differentiably.

    Args:
        gaussians: adapted or not; without ``sigma_d`` the dial does nothing.
        camera: where from.
        virtual_scale: the dial s >= 1 (the paper's s_v).
        background: ``[3]``, black by default.
        rasterizer: the fastest one for the Gaussians' device by default.

    Raises:
        ClodError: the dial is below 1 or not finite.
    """
    attenuated = dial(gaussians, camera, virtual_scale)
    image, alpha = splat(gaussians, attenuated.drawn, camera, background=background, rasterizer=rasterizer)
    return Rendering(image, alpha, attenuated.keep)
