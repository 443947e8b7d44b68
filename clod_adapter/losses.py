"""A render compared with a photograph: the photometric loss, its parts L1, SSIM and PSNR on any
device, and reports.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def psnr(image: Tensor, target: Tensor) -> float:
    """PSNR in dB of a ``[H, W, 3]`` float render, clamped to [0, 1], against a uint8 photograph; on
    its device.

    ``-10 log10 mean (image - target)^2``; infinite for equal images, NaN if a pixel of the render
    is NaN.
    """
    return decibels(mean_squared_error(image, target))


def mean_squared_error(image: Tensor, target: Tensor) -> float:
    """``mean (image - target)^2`` of ``psnr``."""
    difference = image.detach().clamp(0, 1) - unit(target, image)
    return float(difference.double().square().mean())


def decibels(error: float) -> float:
    """PSNR in dB of a mean squared error of colours in [0, 1]."""
    return math.inf if error == 0 else -10 * math.log10(error)


def psnr_ssim(image: Tensor, target: Tensor) -> tuple[float, float]:
    """``psnr``, and the mean structural similarity in [-1, 1] (Wang et al. 2004), as evaluations
    report them.

    The similarity is scikit-image's: Gaussian window of 11 taps with sigma 1.5, population
    covariance, data range 1. As in 3DGS, windows at the border read zeros beyond it and every pixel
    counts: scikit-image leaves out the pixels within 5 of the border, and zeros added there are
    what it leaves out here.
    """
    from skimage.metrics import structural_similarity

    clamped = image.detach().clamp(0, 1).cpu()
    render = clamped.numpy()
    photograph = unit(target, clamped).numpy()
    border = [(WINDOW // 2, WINDOW // 2)] * 2 + [(0, 0)]
    similarity = structural_similarity(
        np.pad(photograph, border),
        np.pad(render, border),
        gaussian_weights=True,
        sigma=SIGMA,
        use_sample_covariance=False,
        data_range=1,
        channel_axis=-1,
    )
    return psnr(clamped, target), float(similarity)


def ssim_plain(image: Tensor, target: Tensor) -> Tensor:
    """``psnr_ssim``'s similarity of two ``[H, W, 3]`` float images in [0, 1]: a 0-d tensor,
    differentiable.
    """
    places = torch.arange(WINDOW, dtype=image.dtype, device=image.device)
    taps = torch.exp(-((places - WINDOW // 2) ** 2) / (2 * SIGMA**2))
    taps = taps / taps.sum()

    def blur(planes: Tensor) -> Tensor:
        planes = conv2d(planes, taps[None, None, None], padding=(0, WINDOW // 2))
        return conv2d(planes, taps[None, None, :, None], padding=(WINDOW // 2, 0))

    x, y = (v.permute(2, 0, 1)[:, None] for v in (image, target))
    blurred = blur(torch.cat([x, y, x * x, y * y, x * y]))
    mx, my = blurred[:6].split(3)
    xx, yy, xy = blurred[6:].split(3)
    similarity = (2 * mx * my + C1) * (2 * (xy - mx * my) + C2)
    largest = (mx * mx + my * my + C1) * (xx - mx * mx + yy - my * my + C2)
    return (similarity / largest).mean()


def photometric_loss(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """``(1 - w) mean |image - target| + w (1 - SSIM)``, w = ssim_weight (3DGS; CLoD-GS's L_render
    has 0.2).

    Takes a float render ``[H, W, 3]`` that is not clamped, and a uint8 photograph.
    """
    if image.device.type == "cpu" and image.dtype == torch.float32:
        return _FusedLoss.apply(image, target, ssim_weight)  # type: ignore[no-any-return, no-untyped-call]
    photograph = unit(target, image)
    l1 = (image - photograph).abs().mean()
    dissimilarity = 1 - ssim_plain(image, photograph)
    return (1 - ssim_weight) * l1 + ssim_weight * dissimilarity


def unit(photograph: Tensor, like: Tensor) -> Tensor:
    """A uint8 photograph in [0, 1], of the type and on the device of ``like``; transferred as
    bytes.
    """
    on_device = photograph.to(like.device, non_blocking=like.device.type != "cpu")
    return on_device.to(like.dtype) / 255


class _FusedLoss(torch.autograd.Function):
    """``photometric_loss`` on the CPU in float32, with its gradient, in one pass."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        from clod_adapter._kernels import ssim as kernels
        from clod_adapter._kernels import threads
        from clod_adapter._kernels.memory import recycled

        l1 = (1 - ssim_weight) / image.numel()
        dssim = ssim_weight / image.numel()
        height, width, _ = image.shape
        workers = threads.worker_count()
        shape = (3, height, kernels.stride(width))
        planes = kernels.Planes(*(recycled(shape).numpy() for _ in range(5)))
        for plane in (planes.x, planes.y):
            # lanes beyond the image; margins of the other planes are not read
            plane[:, :, kernels.PAD + width :] = 0
        room = np.zeros((workers, kernels.LINES * shape[2]), np.float32)
        sums = np.zeros(workers)
        differences = np.zeros(workers)
        gradient = torch.empty(height, width, 3, dtype=torch.float32, device="cpu")
        images = (tensor.detach().contiguous().numpy() for tensor in (image, target))
        threads.run(kernels.to_planes, workers, *images, planes)
        threads.run(kernels.ssim_slopes, workers, planes, width, room, sums)
        written = gradient.numpy(), differences
        threads.run(kernels.loss_gradient, workers, planes, width, room, l1, dssim, *written)
        ctx.save_for_backward(gradient)
        difference = float(differences.sum())
        similarity = float(sums.sum())
        return torch.tensor(l1 * difference + ssim_weight - dssim * similarity, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        return upstream * ctx.saved_tensors[0], None, None
