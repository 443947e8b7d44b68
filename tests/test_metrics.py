"""PSNR and SSIM as the field reports them."""

from __future__ import annotations

import math

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio

from clod_adapter.losses import ssim_plain
from clod_adapter.metrics import psnr, psnr_ssim


@pytest.mark.parametrize("seed", range(3))
def test_psnr_is_scikit_image_s(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    target = torch.randint(0, 256, (20, 30, 3), generator=g).to(torch.uint8)
    image = (target.float() / 255 + 0.1 * torch.randn(20, 30, 3, generator=g)).requires_grad_()
    psnr, similarity = psnr_ssim(image, target)
    shown, wanted = image.detach().clamp(0, 1), target.float() / 255
    want = peak_signal_noise_ratio(wanted.double().numpy(), shown.double().numpy(), data_range=1)
    assert psnr == pytest.approx(want, abs=1e-4), f"seed {seed}"
    assert similarity == pytest.approx(ssim_plain(shown, wanted).item(), abs=1e-6)
    assert isinstance(psnr, float) and isinstance(similarity, float)


def test_renders_are_clamped_first() -> None:
    target = torch.tensor([0, 255], dtype=torch.uint8).repeat(6, 3)[..., None].expand(6, 6, 3).contiguous()
    beyond = torch.where(target > 0, 7.0, -3.0)
    assert psnr_ssim(beyond, target) == (math.inf, pytest.approx(1, abs=1e-6))


def test_a_picture_that_is_no_number_is_not_taken_for_the_photograph() -> None:
    picture, target = torch.zeros(12, 12, 3), torch.zeros(12, 12, 3, dtype=torch.uint8)
    assert psnr(picture, target) == math.inf
    picture[3, 4, 1] = math.nan
    assert math.isnan(psnr(picture, target))


def test_known_value() -> None:
    grey = torch.full((12, 12, 3), 0.5)
    assert psnr_ssim(grey, torch.zeros(12, 12, 3, dtype=torch.uint8))[0] == pytest.approx(20 * math.log10(2), abs=1e-6)
