"""Rendering of Gaussians at a dial value: attenuate, cull, rasterize."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from clod_adapter._support.arrays import float_tensor
from clod_adapter.cameras import Camera
from clod_adapter.equation.attenuation import Attenuated, attenuate, check_dial, warn_of_no_dial
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers import Rasterizer, for_device


@dataclass(frozen=True)
class Rendering:
    """An image, its alpha and the Gaussians it shows.

    Attributes:
        image: ``[H, W, 3]`` float, not clamped.
        alpha: ``[H, W]`` accumulated opacity.
        gaussians, camera, virtual_scale: what was rendered.
    """

    image: Tensor
    alpha: Tensor
    gaussians: Gaussians
    camera: Camera
    virtual_scale: float

    @cached_property
    def kept(self) -> Tensor:
        """``[N]`` bool, the Gaussians that the dial keeps; culled ones are neither sorted nor drawn.

        Computed where it is first asked for, from the Gaussians as they are then: a frame does not need it.
        """
        return dial(self.gaussians, self.camera, self.virtual_scale).keep

    @property
    def pixels(self) -> Tensor:
        """``[H, W, 3]`` uint8, the image as files store it."""
        return (self.image.clamp(0, 1) * 255).round().to(torch.uint8)


def dial(gaussians: Gaussians, seen_from: Camera | Tensor, virtual_scale: float) -> Attenuated:
    """``attenuation.attenuate`` of a container of Gaussians: their opacities and growth at one dial value.

    Without a ``sigma_d`` the dial has no effect: stored opacities, all kept.

    Args:
        seen_from: the camera, or ``[N]`` distances d where they are known.

    Raises:
        ClodError: the dial is negative or not finite.
    """
    where = seen_from if isinstance(seen_from, Tensor) else (gaussians.means, seen_from)
    return attenuate(
        gaussians.opacity_logits, gaussians.sigma_d, where, virtual_scale, gaussians.attenuation,
        growth_d=gaussians.growth_d,
    )  # fmt: skip


def splat(
    gaussians: Gaussians,
    opacities: Tensor,
    camera: Camera,
    *,
    growth: Tensor | None = None,
    background: Tensor | None = None,
    rasterizer: Rasterizer | None = None,
) -> tuple[Tensor, Tensor]:
    """Image ``[H, W, 3]`` and alpha ``[H, W]`` of the Gaussians with the given ``opacities [N]``.

    Args:
        growth: ``[N]`` factor of the scales; None for 1.

    Raises:
        ClodError: the opacities or the background have the wrong shape.
    """
    if opacities.shape != (len(gaussians),):
        raise ClodError(f"opacities are {tuple(opacities.shape)} and must be ({len(gaussians)},)")
    rasterize = rasterizer or for_device(gaussians.means.device)
    behind = _behind(gaussians, background)
    scales = gaussians.scales if growth is None else gaussians.scales * growth[:, None]
    return rasterize(
        gaussians.means, gaussians.quats, scales, opacities, gaussians.sh0, gaussians.shN, camera, behind,
        gaussians.screen_filter,
    )  # fmt: skip


def render(
    gaussians: Gaussians,
    camera: Camera,
    virtual_scale: float = 1.0,
    *,
    background: Tensor | np.ndarray | None = None,
    rasterizer: Rasterizer | None = None,
) -> Rendering:
    """Renders at one dial value, differentiably.

    Args:
        gaussians: adapted or not; without ``sigma_d`` the dial has no effect, and above s = 1 a warning says so.
        camera: the view.
        virtual_scale: the dial s >= 0 (the paper's s_v).
        background: ``[3]``, tensor or array; black by default.
        rasterizer: the fastest one for the Gaussians' device by default.

    Raises:
        ClodError: the dial is negative or not finite.
    """
    check_dial(virtual_scale)
    if gaussians.sigma_d is None:
        warn_of_no_dial(virtual_scale, "give the result of clod_adapter.adapt")
    behind = None if background is None else float_tensor(background)
    if rasterizer is None and _drawn_at_once(gaussians, behind):
        from clod_adapter.rasterizers import cpu

        image, alpha = cpu.draw(gaussians, camera, virtual_scale, _behind(gaussians, behind))
    else:
        attenuated = dial(gaussians, camera, virtual_scale)
        image, alpha = splat(
            gaussians, attenuated.drawn, camera, growth=attenuated.growth, background=behind,
            rasterizer=rasterizer,
        )  # fmt: skip
    return Rendering(image, alpha, gaussians, camera, virtual_scale)


def _behind(gaussians: Gaussians, background: Tensor | None) -> Tensor:
    if background is None:
        return torch.zeros(3, dtype=torch.float32, device=gaussians.means.device)
    if background.shape != (3,):
        raise ClodError(f"background is {tuple(background.shape)} and must be (3,)")
    return background


def _drawn_at_once(gaussians: Gaussians, background: Tensor | None) -> bool:
    """Whether the CPU's rasterizer can apply the dial itself."""
    given = [*gaussians.tensors().values(), *([] if background is None else [background])]
    return all(x.device.type == "cpu" and x.dtype == torch.float32 for x in given)
