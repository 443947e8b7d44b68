"""Coverage: the pixels that each Gaussian covers in a view."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.render import splat

SMALLER = 4  # downscaling of ``reduced``


def coverage(gaussians: Gaussians, opacities: Tensor, camera: Camera, growth: Tensor | None = None) -> Tensor:
    """``[N]`` pixels that each Gaussian covers: the sum over the image of its transmittance times its alpha.

    This is the gradient of the image by the Gaussians' colours.

    Args:
        growth: ``[N]`` factor of the scales; None for 1.
    """
    grey = gaussians.sh0.new_zeros(gaussians.sh0.shape).requires_grad_()
    plain = gaussians.replace(sh0=grey, shN=gaussians.shN[:, :0])
    image, _ = splat(plain, opacities, camera, growth=growth)
    (gradient,) = torch.autograd.grad(image[..., 0].sum(), grey)
    return gradient[:, 0, 0] / SH_C0


def reduced(camera: Camera) -> Camera:
    """The same view with a SMALLER-th of the width and height, where shares of an image are as good."""
    width, height = (max(size // SMALLER, 1) for size in (camera.width, camera.height))
    shrink = camera.K.new_tensor([[width / camera.width], [height / camera.height], [1.0]])
    return replace(camera, K=camera.K * shrink, width=width, height=height)
