"""Rendering of Gaussians at a dial value: attenuate, cull, rasterize."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import require
from clod_adapter.equation.attenuation import dial, warn_of_no_dial
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
        """``[N]`` bool, the Gaussians that the dial keeps, computed when it is first asked for: a
        frame needs none.
        """
        return dial(self.gaussians, self.camera, self.virtual_scale).keep

    @property
    def pixels(self) -> Tensor:
        """``[H, W, 3]`` uint8, the image as files store it."""
        return (self.image.clamp(0, 1) * 255).round().to(torch.uint8)


def splat(
    gaussians: Gaussians,
    opacities: Tensor,
    camera: Camera,
    growth: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Image ``[H, W, 3]`` on black and alpha ``[H, W]``, of activated opacities ``[N]`` and scales
    times ``growth``.
    """
    if opacities.shape != (len(gaussians),):
        raise ClodError(f"opacities are {tuple(opacities.shape)} and must be ({len(gaussians)},)")
    growth = torch.ones_like(opacities) if growth is None else growth
    rasterizer = for_device(gaussians.means.device)
    return rasterizer.draw_opacities(gaussians, opacities, growth, camera)


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
        gaussians: adapted or not; without ``sigma_d`` the dial has no effect, and above s = 1 a
            warning says so.
        camera: the view.
        virtual_scale: the dial s >= 0 (the paper's s_v).
        background: ``[3]``, tensor or array; black by default.
        rasterizer: the fastest one for the Gaussians' device by default.

    Raises:
        ClodError: the dial is negative or not finite, or an argument is of another type.

    Example:
        >>> model, scene = clod.load("model.ply"), clod.load_scene("scene")
        >>> rendering = clod.render(model.gaussians, scene.test[0].camera, virtual_scale=3)
        >>> print(rendering.image.shape, int(rendering.kept.sum()))
    """
    for name, value, kind in (("gaussians", gaussians, Gaussians), ("camera", camera, Camera)):
        require(
            isinstance(value, kind),
            name,
            f"a {type(value).__name__}",
            f"of type {kind.__name__}",
        )
    if gaussians.sigma_d is None:
        warn_of_no_dial(virtual_scale, "give the result of clod_adapter.adapt")
    chosen = rasterizer or for_device(gaussians.means.device)
    # positions of 3 digits draw another image
    with torch.autocast(gaussians.means.device.type, enabled=False):
        image, alpha = chosen.draw(gaussians, camera, virtual_scale, background=background)
    return Rendering(image, alpha, gaussians, camera, virtual_scale)
