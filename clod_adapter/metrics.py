"""Image metrics that are reported, from scikit-image: clamped renders against 8-bit photographs.

Training and its decisions take theirs from ``losses``, which runs on the tensors' own device; a test ties the two.
"""

import numpy as np
from torch import Tensor

from clod_adapter.losses import SIGMA, WINDOW, unit


def psnr(image: Tensor, target: Tensor) -> float:
    """PSNR in dB of a ``[H, W, 3]`` float render, clamped to [0, 1], against a uint8 photograph.

    ``-10 log10 mean (image - target)^2``; infinite for equal images, NaN if a pixel of the render is NaN.
    """
    from skimage.metrics import peak_signal_noise_ratio

    shown, photograph = _arrays(image, target)
    with np.errstate(divide="ignore"):  # equal images
        return float(peak_signal_noise_ratio(photograph, shown, data_range=1))


def psnr_ssim(image: Tensor, target: Tensor) -> tuple[float, float]:
    """``psnr``, and the mean structural similarity in [-1, 1] (Wang et al. 2004) of the same two images.

    Gaussian window of 11 taps with sigma 1.5, population covariance, data range 1. As in 3DGS, windows at the border
    read zeros beyond it and every pixel counts: scikit-image leaves out the pixels within 5 of the border, and zeros
    added there are what it leaves out here.
    """
    from skimage.metrics import structural_similarity

    shown, photograph = _arrays(image, target)
    border = [(WINDOW // 2, WINDOW // 2)] * 2 + [(0, 0)]
    similarity = structural_similarity(
        np.pad(photograph, border), np.pad(shown, border), gaussian_weights=True, sigma=SIGMA,
        use_sample_covariance=False, data_range=1, channel_axis=-1,
    )  # fmt: skip
    return psnr(image, target), float(similarity)


def _arrays(image: Tensor, target: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """The clamped render and the photograph, both in [0, 1], on the CPU."""
    shown = image.detach().clamp(0, 1).cpu()
    return shown.numpy(), unit(target, shown).numpy()
