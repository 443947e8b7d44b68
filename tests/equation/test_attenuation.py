"""The equation against mpmath, autograd against finite differences, and the properties the dial stands on."""

from __future__ import annotations

import itertools
import math

import mpmath
import pytest
import torch
from torch import Tensor

from clod_adapter.equation.attenuation import SIGMA_MAX, attenuate
from clod_adapter.equation.extinction import extinction_scale, sigma_for_extinction
from clod_adapter.errors import ClodError
from clod_adapter.training.paper import soft_count
from exact import (
    DISTANCES,
    DTYPES,
    EPSILONS,
    LOGITS,
    SCALES,
    SIGMAS,
    ZERO,
    assert_close,
    config,
    grid,
    log_opacity,
    reference,
)

# Each eps, each dial value and both types: pairs.
PAIRS = pytest.mark.parametrize(
    ("eps", "scale", "dtype"),
    [(eps, scale, DTYPES[(i + j) % 2]) for i, eps in enumerate(EPSILONS) for j, scale in enumerate(SCALES)],
)


@PAIRS
def test_log_attenuation_and_its_slope_match_mpmath(dtype: torch.dtype, eps: float, scale: float) -> None:
    sigma, d = (t.to(dtype) for t in grid(SIGMAS, DISTANCES))
    sigma.requires_grad_()
    out = attenuate(torch.full_like(d, math.inf), sigma, d, scale, config(eps=eps)).log_opacities
    out.sum().backward()
    want = [reference(a, b, scale, eps) for a, b in zip(sigma.tolist(), d.tolist(), strict=True)]
    assert_close(out.detach(), [w.log_factor for w in want], ulps=4)
    limit = torch.finfo(dtype).max
    slopes = [ZERO if w.slope > limit else w.slope for w in want]
    assert sigma.grad is not None
    assert_close(sigma.grad, slopes, ulps=4)


@PAIRS
def test_opacities_and_their_gradients_match_mpmath(dtype: torch.dtype, eps: float, scale: float) -> None:
    inputs = grid(LOGITS, SIGMAS, DISTANCES)
    logits, sigma, d = (t.to(dtype) for t in inputs)
    logits.requires_grad_()
    sigma.requires_grad_()
    out = attenuate(logits, sigma, d, scale, config(eps=eps))
    by_logit, by_sigma = torch.autograd.grad(out.opacities.sum(), (logits, sigma), retain_graph=True)
    (log_by_logit,) = torch.autograd.grad(out.log_opacities.sum(), logits)
    logits = inputs[0].tolist()
    factors = [reference(a, b, scale, eps) for a, b in zip(*(c.tolist() for c in inputs[1:]), strict=True)]
    logs = [log_opacity(a) + f.log_factor for a, f in zip(logits, factors, strict=True)]
    opacities = [mpmath.exp(x) for x in logs]
    transparency = [1 / (1 + mpmath.exp(mpmath.mpf(a))) for a in logits]
    # exp turns u's error into a relative one; from float32's inputs u is float64's until after it.
    soft = [4 + 3 * float(min(-f.log_factor, 1e4)) if dtype == torch.float64 else 4.0 for f in factors]
    tiny = torch.finfo(dtype).tiny
    assert_close(out.log_opacities.detach(), logs, ulps=4)
    assert_close(out.opacities.detach(), opacities, soft)
    assert_close(log_by_logit, transparency, ulps=4)
    assert_close(by_logit, [a * t for a, t in zip(opacities, transparency, strict=True)], soft)
    slopes = [ZERO if f.slope > torch.finfo(dtype).max else f.slope for f in factors]
    # Where a'' itself is denormal its product with a steep slope has that error and no other.
    floors = [float(4 * tiny * s) for s in slopes]
    assert_close(by_sigma, [a * s for a, s in zip(opacities, slopes, strict=True)], soft, floors)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scale", SCALES[:3])
def test_what_the_soft_cut_draws_matches_mpmath(dtype: torch.dtype, scale: float) -> None:
    tau = 0.02
    inputs = grid([-3.7, -3.1, -1.6, *LOGITS], [*SIGMAS, 0.2, 0.6], [*DISTANCES, 0.15])
    logits, sigma, d = (t.to(dtype) for t in inputs)
    logits.requires_grad_()
    sigma.requires_grad_()
    out = attenuate(logits, sigma, d, scale, config(tau, cut="soft"))
    by_logit, by_sigma = torch.autograd.grad(out.drawn.sum(), (logits, sigma))
    want, floors, slopes, transparency = [], [], [], []
    for a, b, c in zip(*(x.tolist() for x in inputs), strict=True):
        factor = reference(b, c, scale, 1e-8)
        log = log_opacity(a) + factor.log_factor
        ratio = mpmath.exp(log) / (mpmath.mpf(tau) * scale)
        want.append(mpmath.exp(log) * min(max(2 * (ratio - 1), ZERO), 1))
        # By log a'', where there is a slope: below 1.5 tau s the fade's own part is added to that of a''.
        inside = 1 < ratio < 1.5
        slopes.append((factor.slope, mpmath.exp(log) * (4 * ratio - 2 if inside else ratio >= 1.5)))
        transparency.append(1 / (1 + mpmath.exp(mpmath.mpf(a))))
        # The threshold's distance is a difference of logarithms, whose rounding the fade triples.
        floors.append(float(mpmath.exp(log)) * 4 * (8 + float(min(abs(log), 1e4))) * torch.finfo(dtype).eps)
    assert_close(out.drawn.detach(), want, 8, floors)
    gained = [2 * floor for floor in floors]
    assert_close(by_logit, [s * t for (_, s), t in zip(slopes, transparency, strict=True)], 12, gained)
    by_slope = [f * float(k) for f, (k, _) in zip(gained, slopes, strict=True)]
    assert_close(by_sigma, [k * s for k, s in slopes], 20, by_slope)
    assert any(0 < g < 1 for g in (out.drawn / out.opacities).nan_to_num().tolist())


@pytest.mark.parametrize("cut", ["hard", "soft"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_what_is_kept_is_what_is_drawn(dtype: torch.dtype, cut: str) -> None:
    """Of Gaussians that stand at the threshold, to 64 roundings of s."""
    generator = torch.Generator().manual_seed(0)
    logits, d = (torch.rand(20_000, generator=generator, dtype=dtype) for _ in range(2))
    for s in (1.0, 1.7, 3.3, 5.0):
        chosen = config(0.02, cut=cut)
        extinction = s * (1 + torch.linspace(-64, 64, len(d), dtype=dtype) * torch.finfo(dtype).eps)
        at = (8 * logits - 2, sigma_for_extinction(8 * logits - 2, d, extinction, chosen), d)
        out = attenuate(*at, s, chosen)
        assert 0.05 < out.keep.float().mean() < 0.95
        assert torch.equal(out.drawn > 0, out.keep)


@pytest.mark.parametrize("dtype", DTYPES)
def test_identity_is_bit_exact(dtype: torch.dtype) -> None:
    logits = torch.cat([torch.linspace(-120, 60, 4001), torch.tensor([math.inf, -math.inf])]).to(dtype)
    d = torch.linspace(0, 1.5, len(logits)).to(dtype)
    far = attenuate(logits, torch.full_like(d, SIGMA_MAX), d, 6.0, config())
    assert torch.equal(far.opacities, logits.sigmoid())
    near = attenuate(logits, torch.linspace(-1, 1, len(logits)).to(dtype), torch.zeros_like(d), 6.0, config(eps=0.0))
    assert torch.equal(near.opacities, logits.sigmoid())
    widest = torch.full_like(d, 2e5 if dtype == torch.float32 else 10.0)
    at_most = attenuate(logits, torch.full_like(d, SIGMA_MAX), widest, 1.0, config(eps=0.0))
    assert torch.equal(at_most.opacities, logits.sigmoid())


@pytest.mark.parametrize("eps", [0.0, 1e-100, 1e-8])
@pytest.mark.parametrize("dtype", DTYPES)
def test_edges_are_never_nan(dtype: torch.dtype, eps: float) -> None:
    edge = [0.0, 1e-45, 1e-30, 1e-12, 1.0, 1e12, 1e30]
    logits, sigma, d = (
        torch.tensor(c, dtype=dtype)
        for c in zip(*itertools.product([*LOGITS, -math.inf, -1e4, -1e30], [*edge, -1.0, -1e30], edge), strict=True)
    )
    logits.requires_grad_()
    sigma.requires_grad_()
    out = attenuate(logits, sigma, d, 7.0, config(eps=eps))
    count = soft_count(out.log_opacities, 7.0, 1 / 255, 0.1)
    results: list[Tensor] = [*out[:4], count, extinction_scale(logits, sigma, d, config(eps=eps))]
    results += [sigma_for_extinction(logits, d, d, config(eps=eps))]
    for loss in (out.opacities.sum(), count, out.log_opacities.sum(), 0 * out.opacities.sum()):
        results += torch.autograd.grad(loss, (logits, sigma), retain_graph=True)
    results += torch.autograd.grad(out.log_opacities, (logits, sigma), torch.zeros_like(d), retain_graph=True)
    assert not any(r.isnan().any() for r in results)
    assert all((r == 0).all() for r in results[-2:])
    if eps == 0:
        gone = (sigma <= 0) & (d > 0)
        assert (out.log_opacities[gone] == -math.inf).all()
        assert (extinction_scale(logits, sigma, d, config(eps=eps))[gone] == 0).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype) -> None:
    logits, sigma, d = (torch.linspace(a, b, 50).to(dtype) for a, b in ((-4, 4), (0.01, 1), (0, 1)))
    sigma.requires_grad_()
    out = attenuate(logits, sigma, d, 3.0, config())
    want = attenuate(logits.float(), sigma.float(), d.float(), 3.0, config())
    assert out.opacities.dtype == torch.float32 and torch.equal(out.opacities, want.opacities)
    (grad,) = torch.autograd.grad(out.opacities.sum(), sigma)
    assert grad.dtype == dtype and grad.isfinite().all()
    assert extinction_scale(logits, sigma, d, config()).dtype == torch.float32


def test_bad_calls_are_named() -> None:
    three, four = torch.ones(3), torch.ones(4)
    with pytest.raises(ClodError, match="virtual_scale is -0.5"):
        attenuate(three, three, three, -0.5, config())
    with pytest.raises(ClodError, match=r"sigma_d \(4,\)"):
        extinction_scale(three, four, three, config())
    with pytest.raises(ClodError, match="sigma_d is no tensor but ndarray; pass torch.as_tensor of it"):
        attenuate(three, three.numpy(), three, 2.0, config())


@pytest.mark.parametrize("cut", ["hard", "soft"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_activated_opacities_give_what_their_logits_do(cut: str, dtype: torch.dtype) -> None:
    logits, sigma, d = (column.to(dtype) for column in grid(LOGITS, SIGMAS, DISTANCES))
    for scale in SCALES:
        settings = config(0.3 / scale, cut=cut)
        want = attenuate(logits, sigma, d, scale, settings)
        got = attenuate(logits.sigmoid(), sigma, d, scale, settings, activated=True)
        assert torch.equal(got.opacities, want.opacities) and torch.equal(got.keep, want.keep)
        # The fade is a difference of logarithms, which differ by their rounding.
        torch.testing.assert_close(got.drawn, want.drawn, rtol=0, atol=8 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("cut", ["hard", "soft"])
def test_gradients_of_activated_opacities(cut: str) -> None:
    """Against finite differences, and by hand at 0 and 1, where logits are infinite."""

    def drawn(a: Tensor, sigma: Tensor, d: list[float], s: float) -> Tensor:
        return attenuate(a, sigma, torch.tensor(d).double(), s, config(0.02, cut=cut), activated=True).drawn

    a = torch.tensor([0.05, 0.3, 0.9, 0.999, 0.041], dtype=torch.float64, requires_grad=True)
    sigma = torch.tensor([2.0, 0.7, 0.4, 30.0, 9.0], dtype=torch.float64, requires_grad=True)
    assert (drawn(a, sigma, [0.1, 0.4, 0.3, 0.0, 0.2], 2.0) > 0).all()
    assert torch.autograd.gradcheck(lambda *x: drawn(*x, [0.1, 0.4, 0.3, 0.0, 0.2], 2.0), (a, sigma))
    ends = torch.tensor([0.0, 1.0, 0.0, 1.0], dtype=torch.float64, requires_grad=True)
    reach = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    found = drawn(ends, reach, [0.5, 0.5, 0.0, 0.0], 1.0)
    assert (found > 0).tolist() == [False, True, False, True]
    slope_a, slope_sigma = (slope.tolist() for slope in torch.autograd.grad(found.sum(), [ends, reach]))
    factor = math.exp(-0.125)
    assert slope_a == pytest.approx([0, factor, 0, 1]) and slope_sigma == pytest.approx([0, factor / 4, 0, 0])
