"""The fused loss against plain torch, and the padding of SSIM; test_metrics.py has scikit-image's."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from backends import torch_threads
from clod_adapter.losses import photometric_loss, photometric_loss_plain

# Smaller than the window of 11, one larger, multiples of 16 and not.
SIZES = [(1, 1), (3, 7), (11, 11), (12, 16), (33, 50), (17, 101)]


def pair(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A smooth photograph with black and white parts, and a render of it that also leaves [0, 1]."""
    g = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    waves = torch.sin(x[..., None] / torch.tensor([3.0, 5.0, 9.0]) + y[..., None] / 4)
    clean = (0.5 + 0.8 * waves).clamp(0, 1)
    target = (clean * 255).round().to(torch.uint8)
    image = clean + 0.1 * torch.randn(height, width, 3, generator=g)
    image[:, : width // 4] = clean[:, : width // 4].round()  # exactly the photograph where it is black
    return image, target


def value_and_gradient(function, image: Tensor, target: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    leaf = image.clone().requires_grad_()
    loss = function(leaf, target, weight)
    (gradient,) = torch.autograd.grad(loss, leaf)
    return loss.detach(), gradient


@pytest.mark.parametrize(("size", "weight"), [(size, (0.0, 0.2, 1.0)[k % 3]) for k, size in enumerate(SIZES)])
def test_fused_loss_matches_the_plain_loss(size: tuple[int, int], weight: float) -> None:
    """In float32, against float64: the value within 2e-6, the gradient within 1e-4 of its length."""
    image, target = pair(*size)
    loss, gradient = value_and_gradient(photometric_loss, image, target, weight)
    want, expected = value_and_gradient(photometric_loss_plain, image.double(), target, weight)
    assert loss.dtype == torch.float32 and loss.shape == () and gradient.shape == image.shape
    assert abs(loss.item() - want.item()) <= 2e-6
    # |x| has no slope at 0, where float32 may see a difference that float64 does not.
    clear = ((image.double() - target.double() / 255).abs() > 1e-6) | (image == 0)
    error = (gradient.double() - expected)[clear].norm().item()
    assert error <= 1e-4 * expected.norm().item()
    double = photometric_loss(image.double(), target, weight)  # takes the plain way
    assert double.dtype == torch.float64 and double == want


def test_threads_and_strides_change_nothing() -> None:
    image, target = pair(33, 50)
    want = value_and_gradient(photometric_loss, image, target, 0.2)
    for count in (1, 2, 3):
        with torch_threads(count):
            (loss, gradient), again = (value_and_gradient(photometric_loss, image, target, 0.2) for _ in range(2))
        assert torch.equal(loss, again[0]) and torch.equal(gradient, again[1])
        torch.testing.assert_close(loss, want[0], rtol=1e-6, atol=0)
        assert torch.equal(gradient, want[1])
    wide = torch.stack([image, image * 0], -1)[..., 0]
    turned = target.transpose(0, 1).contiguous().transpose(0, 1)
    assert not wide.is_contiguous() and not turned.is_contiguous()
    assert all(map(torch.equal, value_and_gradient(photometric_loss, wide, turned, 0.2), want))
    _, scaled = value_and_gradient(lambda *a: 8 * photometric_loss(*a), image, target, 0.2)
    assert torch.equal(scaled, 8 * want[1])
