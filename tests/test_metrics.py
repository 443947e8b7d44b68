"""The reports' PSNR and SSIM agree with training's and with scikit-image's."""

from __future__ import annotations

import math

import pytest
import torch
from skimage.data import coffee
from torch import Tensor

from clod_adapter import losses
from clod_adapter.metrics import psnr, psnr_ssim

# The window has 11 taps: images smaller, as large and larger.
SIZES = [(1, 1), (3, 40), (37, 53)]


def noisy(target: Tensor) -> Tensor:
    """A render of the photograph that also leaves [0, 1]."""
    generator = torch.Generator().manual_seed(target.numel())
    return target / 255 + 0.1 * torch.randn(target.shape, generator=generator)


def random_target(height: int, width: int) -> Tensor:
    generator = torch.Generator().manual_seed(height)
    return torch.randint(0, 256, (height, width, 3), generator=generator).to(torch.uint8)


def real_target() -> Tensor:
    return torch.from_numpy(coffee()[100:260, 150:350].copy())


@pytest.mark.parametrize("target", [*map(random_target, *zip(*SIZES, strict=True)), real_target(), real_target() // 40])
def test_training_and_report_metrics_agree(target: Tensor) -> None:
    image = noisy(target)
    shown, photo = image.clamp(0, 1), target / 255
    value, similarity = psnr_ssim(image.requires_grad_(), target)
    assert isinstance(value, float) and isinstance(similarity, float) and value == psnr(image, target)
    assert value == pytest.approx(losses.psnr(image, target), rel=1e-6)
    fused = 1 - losses.photometric_loss(shown, target, 1.0).item()
    plain = losses.ssim_plain(shown.double(), photo.double()).item()
    assert similarity == pytest.approx(fused, abs=1e-5) and similarity == pytest.approx(plain, abs=1e-5)


@pytest.mark.parametrize("function", [psnr, losses.psnr])
def test_psnr_of_known_images(function) -> None:
    black = torch.zeros(12, 12, 3, dtype=torch.uint8)
    assert function(torch.full((12, 12, 3), 0.5), black) == pytest.approx(20 * math.log10(2), abs=1e-6)
    image = torch.zeros(12, 12, 3)
    assert function(image, black) == math.inf
    image[3, 4, 1] = math.nan
    assert math.isnan(function(image, black))
    stripes = torch.tensor([0, 255], dtype=torch.uint8).repeat(6, 3)[..., None].expand(6, 6, 3).contiguous()
    beyond = torch.where(stripes > 0, 7.0, -3.0)  # renders are clamped first
    assert function(beyond, stripes) == math.inf and psnr_ssim(beyond, stripes)[1] == pytest.approx(1, abs=1e-6)
