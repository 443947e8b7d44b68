"""Photometric loss of a render against a photograph."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity of two ``[H, W, 3]`` float images in [0, 1], a 0-d tensor.

    11-tap Gaussian window with sigma 1.5, zero padding, data range 1: the form 3DGS and its
    descendants report (Wang et al. 2004). Differentiable; plain torch, any device.
    """
    taps = torch.exp(-((torch.arange(WINDOW).to(image) - WINDOW // 2) ** 2) / (2 * SIGMA**2))
    taps = taps / taps.sum()

    def blur(planes: Tensor) -> Tensor:
        planes = conv2d(planes, taps[None, None, None], padding=(0, WINDOW // 2))
        return conv2d(planes, taps[None, None, :, None], padding=(WINDOW // 2, 0))

    x, y = (v.permute(2, 0, 1)[:, None] for v in (image, target))
    mx, my, xx, yy, xy = blur(torch.cat([x, y, x * x, y * y, x * y])).split(3)
    similarity = (2 * mx * my + C1) * (2 * (xy - mx * my) + C2)
    return (similarity / ((mx * mx + my * my + C1) * (xx - mx * mx + yy - my * my + C2))).mean()


def photometric_loss(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """``(1 - w) mean |image - target| + w (1 - SSIM)``, w = ssim_weight (3DGS; CLoD-GS's L_render has 0.2).

    Args:
        image: ``[H, W, 3]`` float render, not clamped.
        target: ``[H, W, 3]`` uint8 photograph.

    On the CPU in float32 one fused pass computes the loss and its gradient; elsewhere plain torch.
    """
    if image.device.type == "cpu" and image.dtype == torch.float32:
        return _FusedLoss.apply(image, target, ssim_weight)  # type: ignore[no-any-return, no-untyped-call]
    return photometric_loss_plain(image, target, ssim_weight)


def photometric_loss_plain(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """The plain twin of ``photometric_loss``."""
    wanted = target.to(image) / 255
    return (1 - ssim_weight) * (image - wanted).abs().mean() + ssim_weight * (1 - ssim(image, wanted))


class _FusedLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        from clod_adapter._kernels import ssim as kernels
        from clod_adapter._kernels import threads

        workers = threads.worker_count()
        height, width, _ = image.shape
        x, y, similarity, g_mean, g_square, g_product = np.zeros((6, 3, height, kernels.stride(width)), np.float32)
        pixels = image.detach().contiguous().numpy()
        threads.run(kernels.to_planes, workers, pixels, target.contiguous().numpy(), x, y, np.float32(1 / 255))
        similarities, differences, gradient = np.zeros(workers), np.zeros(workers), torch.empty(height, width, 3)
        threads.run(kernels.ssim_map, workers, x, y, width, similarity, g_mean, g_square, g_product, similarities)
        l1, dssim = (1 - ssim_weight) / pixels.size, ssim_weight / pixels.size
        threads.run(
            kernels.loss_gradient, workers, x, y, width, g_mean, g_square, g_product, l1, dssim, gradient.numpy(),
            differences,
        )  # fmt: skip
        ctx.save_for_backward(gradient)
        return torch.tensor(l1 * differences.sum() + ssim_weight - dssim * similarities.sum(), dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        return upstream * ctx.saved_tensors[0], None, None
