"""The count term and the losses in float32 against float64."""

import math
from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from backends import torch_threads
from clod_adapter import losses
from clod_adapter.config import AdaptConfig
from clod_adapter.losses import photometric_loss
from clod_adapter.training.target_count import count_gradient
from scenes import seeded

CONFIG = AdaptConfig(max_sv=7.0)


@settings(deadline=None, max_examples=30)
@given(
    n=st.sampled_from([1, 15, 16, 17, 33, 400]),
    s=st.sampled_from([1.0, 2.5, 10.0]),
    seed=st.integers(0, 99),
    share=st.sampled_from([0.02, 0.4, 1.0]),
)
def test_the_count_term_in_float32(n, s, seed, share):
    random = seeded(seed)
    d = 2 * torch.rand(n, generator=random)
    sigma = s * d * (torch.randn(n, generator=random) / 4).exp()
    got = count_gradient(d, sigma, s, 0.1, CONFIG, share)
    want = count_gradient(d.double(), sigma.double(), s, 0.1, CONFIG, share)
    torch.testing.assert_close(
        got.double(), want, rtol=1e-4, atol=1e-6 * max(float(want.abs().max()), 1e-9)
    )
    assert n < 33 or want.any()


def test_the_count_term_of_extreme_values_is_finite():
    edges = (
        torch.tensor([0.0, 1e-30, 1e-6, 1.0, 1e6, 1e9]),
        torch.tensor([-1.0, 0.0, 1e-30, 1e-4, 1.0, 1e9, math.inf]),
    )
    for dtype, share in product((torch.float32, torch.float64), (0.01, 1.0)):
        d, sigma = torch.cartesian_prod(*(edge.to(dtype) for edge in edges)).unbind(1)
        found = count_gradient(d, sigma, 3.0, 0.1, CONFIG, share)
        assert found.isfinite().all() and found.any()


# Smaller than the window of 11, one larger, multiples of 16 and not.
SIZES = [(1, 1), (3, 7), (11, 11), (12, 16), (33, 50), (17, 101)]


def pair(height, width, seed=0):
    """A smooth photograph with black and white parts, and a render of it that also leaves
    [0, 1].
    """
    g = seeded(seed)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    waves = torch.sin(x[..., None] / torch.tensor([3.0, 5.0, 9.0]) + y[..., None] / 4)
    clean = (0.5 + 0.8 * waves).clamp(0, 1)
    target = (clean * 255).round().to(torch.uint8)
    image = clean + 0.1 * torch.randn(height, width, 3, generator=g)
    # exactly the photograph where it is black
    image[:, : width // 4] = clean[:, : width // 4].round()
    return image, target


def value_and_gradient(function, image, target, weight):
    leaf = image.clone().requires_grad_()
    loss = function(leaf, target, weight)
    (gradient,) = torch.autograd.grad(loss, leaf)
    return loss.detach(), gradient


@pytest.mark.parametrize(
    ("size", "weight"), [(size, (0.0, 0.2, 1.0)[k % 3]) for k, size in enumerate(SIZES)]
)
def test_fused_loss_matches_the_plain_loss(size, weight):
    """In float32, against float64: the value within 2e-6, the gradient within 1e-4 of its
    length.
    """
    image, target = pair(*size)
    loss, gradient = value_and_gradient(photometric_loss, image, target, weight)
    want, expected = value_and_gradient(photometric_loss, image.double(), target, weight)
    assert loss.dtype == torch.float32 and loss.shape == () and gradient.shape == image.shape
    assert abs(loss.item() - want.item()) <= 2e-6
    # |x| has no slope at 0, where float32 may see a difference that float64 does not.
    clear = ((image.double() - target.double() / 255).abs() > 1e-6) | (image == 0)
    error = (gradient.double() - expected)[clear].norm().item()
    assert error <= 1e-4 * expected.norm().item()


def test_threads_and_strides_change_nothing():
    image, target = pair(33, 50)
    want = value_and_gradient(photometric_loss, image, target, 0.2)
    for count in (1, 3):
        with torch_threads(count):
            loss, gradient = value_and_gradient(photometric_loss, image, target, 0.2)
        torch.testing.assert_close(loss, want[0], rtol=1e-6, atol=0)
        assert torch.equal(gradient, want[1])
    wide, turned = (
        torch.stack([image, image * 0], -1)[..., 0],
        target.transpose(0, 1).contiguous().transpose(0, 1),
    )
    assert all(map(torch.equal, value_and_gradient(photometric_loss, wide, turned, 0.2), want))
    _, scaled = value_and_gradient(lambda *a: 8 * photometric_loss(*a), image, target, 0.2)
    assert torch.equal(scaled, 8 * want[1])


@pytest.mark.parametrize(
    ("size", "darker"), [(size, (1, 40)[k % 2]) for k, size in enumerate(SIZES)]
)
def test_training_and_report_metrics_agree(size, darker):
    image, target = pair(*size)
    target = target // darker
    shown, photo = image.clamp(0, 1), target / 255
    value, similarity = losses.psnr_ssim(image.requires_grad_(), target)
    assert value == pytest.approx(losses.psnr(image, target), rel=1e-6)
    fused = 1 - losses.photometric_loss(shown, target, 1.0).item()
    plain = losses.ssim_plain(shown.double(), photo.double()).item()
    assert similarity == pytest.approx(fused, abs=1e-5) and similarity == pytest.approx(
        plain, abs=1e-5
    )


@pytest.mark.parametrize("function", [losses.psnr, lambda *given: losses.psnr_ssim(*given)[0]])
def test_psnr_of_known_images(function):
    black = torch.zeros(12, 12, 3, dtype=torch.uint8)
    assert function(torch.full((12, 12, 3), 0.5), black) == pytest.approx(
        20 * math.log10(2), abs=1e-6
    )
    image = torch.zeros(12, 12, 3)
    assert function(image, black) == math.inf
    image[3, 4, 1] = math.nan
    assert math.isnan(function(image, black))
    beyond = 7 * torch.ones(12, 12, 3)  # renders are clamped first
    assert function(beyond, black + 255) == math.inf
