"""Image metrics as the field reports them: clamped renders against 8-bit photographs."""

from __future__ import annotations

import math

from torch import Tensor

from clod_adapter.losses import ssim, unit


def psnr(image: Tensor, target: Tensor) -> float:
    """PSNR in dB of a ``[H, W, 3]`` float render, clamped to [0, 1], against a uint8 photograph.

    ``-10 log10 mean (image - target)^2``; infinite for equal images, NaN where a pixel is.
    """
    error = float((image.detach().clamp(0, 1) - unit(target, image)).double().square().mean())
    return math.inf if error == 0 else -10 * math.log10(error)


def psnr_ssim(image: Tensor, target: Tensor) -> tuple[float, float]:
    """``psnr``, and SSIM of the clamped render (``losses.ssim``)."""
    return psnr(image, target), ssim(image.detach().clamp(0, 1), target)
