"""The photometric loss of a render against a photograph, and its parts: L1, SSIM and PSNR on any device."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


def psnr(image: Tensor, target: Tensor) -> float:
    """PSNR in dB of a ``[H, W, 3]`` float render, clamped to [0, 1], against a uint8 photograph.

    ``-10 log10 mean (image - target)^2``; infinite for equal images, NaN if a pixel of the render is NaN. What the plan
    and the progress display compare; reports have ``metrics.psnr``.
    """
    error = float((image.detach().clamp(0, 1) - unit(target, image)).double().square().mean())
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim_plain(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity of two ``[H, W, 3]`` float images in [0, 1]: a 0-d tensor, differentiable.

    Gaussian window of 11 taps with sigma 1.5, zero padding, data range 1: the form of 3DGS and its descendants (Wang et
    al. 2004).
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

    On the CPU in float32 one fused pass computes the loss and its gradient; otherwise plain torch.
    """
    if image.device.type == "cpu" and image.dtype == torch.float32:
        return _FusedLoss.apply(image, target, ssim_weight)  # type: ignore[no-any-return, no-untyped-call]
    return photometric_loss_plain(image, target, ssim_weight)


def photometric_loss_plain(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """``photometric_loss`` in plain torch."""
    wanted = unit(target, image)
    return (1 - ssim_weight) * (image - wanted).abs().mean() + ssim_weight * (1 - ssim_plain(image, wanted))


def unit(photograph: Tensor, like: Tensor) -> Tensor:
    """A uint8 photograph in [0, 1], of the type and on the device of ``like``; transferred as bytes."""
    return photograph.to(like.device, non_blocking=True).to(like.dtype) / 255


class _Fused:
    """Fused comparison of a render with a photograph on the CPU; owns the kernels' scratch planes."""

    def __init__(self, image: Tensor, target: Tensor) -> None:
        from clod_adapter._kernels import ssim as kernels
        from clod_adapter._kernels import threads

        self.kernels, self.threads, self.workers = kernels, threads, threads.worker_count()
        self.height, self.width, _ = image.shape
        planes = np.zeros((6, 3, self.height, kernels.stride(self.width)), np.float32)
        self.x, self.y, similarity, *self.slopes = planes
        pixels, sums = image.detach().contiguous().numpy(), np.zeros(self.workers)
        threads.run(kernels.to_planes, self.workers, pixels, target.contiguous().numpy(), self.x, self.y)
        threads.run(kernels.ssim_map, self.workers, self.x, self.y, self.width, similarity, *self.slopes, sums)
        self.ssim_sum = sums.sum()

    def gradient(self, l1: float, dssim: float) -> tuple[Tensor, float]:
        """The gradient of ``l1 sum |x - y| - dssim sum SSIM`` with respect to the image, and ``sum |x - y|``."""
        out, sums = torch.empty(self.height, self.width, 3, dtype=torch.float32, device="cpu"), np.zeros(self.workers)
        self.threads.run(
            self.kernels.loss_gradient, self.workers, self.x, self.y, self.width, *self.slopes, l1, dssim, out.numpy(),
            sums,
        )  # fmt: skip
        return out, float(sums.sum())


class _FusedLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        fused, l1, dssim = _Fused(image, target), (1 - ssim_weight) / image.numel(), ssim_weight / image.numel()
        gradient, difference = fused.gradient(l1, dssim)
        ctx.save_for_backward(gradient)
        return torch.tensor(l1 * difference + ssim_weight - dssim * fused.ssim_sum, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        return upstream * ctx.saved_tensors[0], None, None
