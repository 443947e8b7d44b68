"""The target-count curve: its values, its gradients, and convergence of the counts."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.training.paper import paper_count, soft_count
from clod_adapter.training.target_count import TEMPERATURE, count_gradient, count_slope, target_curve, target_share

CONFIG = AdaptConfig(max_sv=6.0)
ATTENUATION = CONFIG.attenuation(1.0)
N = 2000


def some(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Opacity logits, log sigma_d and normalised distances."""
    generator = torch.Generator().manual_seed(seed)
    logits, log_sigma, d = (torch.randn(N, generator=generator) for _ in range(3))
    return 2 * logits + 1, log_sigma * 0.8, (0.3 * d).exp()


def gradient(logits: Tensor, log_sigma: Tensor, d: Tensor, s: float, **changes: float) -> Tensor:
    config = dataclasses.replace(CONFIG, **changes)
    return count_gradient(d, logits, log_sigma.exp(), s, ATTENUATION, 0.1, config, target_share(s, N, config))


def test_count_gradient_penalises_excess_and_deficit() -> None:
    """The gradient is that of the squared excess; it is 0 for a single remaining Gaussian."""
    logits, log_sigma, d = some()
    many, few = log_sigma + 3, log_sigma - 2
    for s in (1.5, 6.0):
        dialled = attenuate(logits, log_sigma.exp(), d, s, ATTENUATION)
        slope = count_slope(logits, dialled.log_opacities, s, ATTENUATION.tau, TEMPERATURE)
        share = target_curve(s, CONFIG.share, CONFIG.exponent)
        excess = float(dialled.keep.float().mean()) / share - 1
        want = 0.1 * 2 * CONFIG.reg_weight * excess / share * slope
        torch.testing.assert_close(gradient(logits, log_sigma, d, s), want)
        assert gradient(logits, many, d, s).max() > 0 >= -gradient(logits, many, d, s).min()
        assert gradient(logits, few, d, s).min() < 0 and gradient(logits, few, d, s).max() <= 0
        assert (gradient(logits, log_sigma, d, s, reg_weight=0.0) == 0).all()
    one, target = torch.ones(1), target_share(5.0, 1, CONFIG)
    assert attenuate(4 * one, 5 * one, one, 5.0, ATTENUATION).keep.all()
    assert count_gradient(one, 4 * one, 5 * one, 5.0, ATTENUATION, 1.0, CONFIG, target).item() == 0
    # Where a'' is 0 at every dial value nothing else has a slope: at the floor that training has, and at 0.
    for gone in (-9.2, -100.0):
        assert (gradient(logits, torch.full((N,), gone), d, 2.0) < 0).all()
    mixed = torch.where(torch.arange(N) % 2 == 0, 5.0, -9.2)  # half are kept, where the curve at s = 6 has 7 %
    assert (gradient(logits, mixed, d, 6.0) >= 0).all() and (gradient(logits, mixed, d, 6.0)[1::2] < 1e-20).all()


def test_count_slope_is_that_of_the_soft_count() -> None:
    """Where 2 u > 1; below, 2 u counts as 1, so that Gaussians without attenuation have a gradient."""
    tau, s, temperature = 0.02, 2.0, 0.5
    logits = torch.linspace(-5, 5, 200, dtype=torch.float64)
    d, log_sigma = torch.linspace(0.1, 1, 200, dtype=torch.float64), torch.linspace(-1, 2, 200, dtype=torch.float64)
    log_sigma = log_sigma[torch.randperm(200, generator=torch.Generator().manual_seed(0))].requires_grad_()
    out = attenuate(logits, log_sigma.exp(), d, s, AttenuationConfig(tau=tau, eps=0.0))
    (want,) = torch.autograd.grad(soft_count(out.log_opacities, s, tau, temperature), log_sigma)
    logs = out.log_opacities.detach()
    got = count_slope(logits, logs, s, tau, temperature)
    touched = 2 * (torch.nn.functional.logsigmoid(logits) - logs)
    assert 20 < int((touched > 1).sum()) < 180
    torch.testing.assert_close(got[touched > 1], want[touched > 1])
    q = torch.sigmoid((logs - math.log(tau * s)) / temperature)
    torch.testing.assert_close(got[touched <= 1], (q * (1 - q) / (temperature * 200))[touched <= 1])


@pytest.mark.parametrize("form", ["ours", "paper"])
def test_shares_count_gaussians_that_are_left_out(form: str) -> None:
    """Gaussians left out because they are never drawn count as culled."""
    logits, log_sigma, d = some()
    logits[40:65], found, s = -40.0, [], 3.0
    for count, total in ((65, None), (40, 65)):
        sigma = log_sigma[:count].exp().requires_grad_()
        dialled = attenuate(logits[:count], sigma, 0.1 * d[:count], s, ATTENUATION)
        if form == "paper":
            paper_count(dialled, s, ATTENUATION.tau, CONFIG, total).backward()
            found.append(sigma.grad[:40])
        else:
            given = 0.1 * d[:count], logits[:count], sigma, s, ATTENUATION
            found.append(count_gradient(*given, 0.3, CONFIG, target_share(s, count, CONFIG, total))[:40])
    assert found[0].abs().max() > 0 and torch.allclose(*found, rtol=1e-5, atol=0)
