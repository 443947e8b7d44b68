"""The equation, its inverse and growth against mpmath at 50 digits, and the properties the dial stands on."""

import itertools
import math
from functools import cache
from typing import Any

import mpmath
import pytest
import torch
from torch import Tensor

from clod_adapter import AttenuationConfig, ClodError
from clod_adapter.equation.attenuation import LOG_GROWTH_MAX, SIGMA_MAX, attenuate, growth_factors
from clod_adapter.equation.extinction import extinction_scale, sigma_for_extinction
from clod_adapter.training.paper import soft_count
from scenes import camera

DTYPES = [torch.float32, torch.float64]
LOGITS = [-200.0, -40.0, -6.0, -1.0, 0.0, 2.0, 9.0, 200.0, math.inf]
SIGMAS = [-1.0, 0.0, 1e-12, 1e-6, 1e-3, 0.05, 0.4, 1.0, 30.0, 1e6, 1e12]
DISTANCES = [0.0, 1e-7, 1e-3, 0.1, 0.7, 1.5]
SCALES = [1.0, 1.75, 7.0, 1e4]
TAUS = [1e-6, 1 / 255, 0.5]
EPSILONS = [0.0, 1e-8, 1e-2]
EXPONENTS = [-300.0, -1.0, -0.3, 0.0, 1e-6, 0.5, 0.75, 1.0, 3.0, 17.0]

mpmath.mp.dps = 50
ZERO = mpmath.mpf(0)
each_dtype = pytest.mark.parametrize("dtype", DTYPES)
each_cut = pytest.mark.parametrize("cut", ["hard", "soft"])


def paired(*axes: list[float]) -> list[tuple[Any, ...]]:
    """Each value of the axes once or twice, in turn in each type."""
    return [(*(axis[k % len(axis)] for axis in axes), DTYPES[k % 2]) for k in range(max(map(len, axes)))]


def config(tau: float = 1 / 255, eps: float = 1e-8, **other: Any) -> AttenuationConfig:
    return AttenuationConfig(tau=tau, eps=eps, **{"max_sv": 1.0} | other)


def grid(*axes: list[float]) -> list[Tensor]:
    """Columns of the axes' product. Values are exact in float32, so both dtypes share one mpmath reference."""
    return list(torch.tensor(list(itertools.product(*axes)), dtype=torch.float32).double().unbind(1))


def assert_close(got: Tensor, want: list[Any], ulps: float | list[float], floor: float | list[float] = 0.0) -> None:
    """Relative error within ulps * finfo.eps, absolute within floor or the smallest normal; too large means inf."""
    info = torch.finfo(got.dtype)
    ulps, floor = (each if isinstance(each, list) else [each] * len(want) for each in (ulps, floor))
    for i, (g, w) in enumerate(zip(got.tolist(), want, strict=True)):
        if abs(w) > info.max:
            assert g == math.copysign(math.inf, w), (i, g, w)
        else:
            error = abs(mpmath.mpf(g) - w)
            assert error <= max(ulps[i] * info.eps * abs(w), info.tiny, floor[i]), (i, g, w)


@cache
def reference(sigma: float, d: float, s: float, eps: float) -> tuple[Any, Any]:
    positive = max(mpmath.mpf(sigma), ZERO)
    v = positive**2 + mpmath.mpf(eps) / 2
    if d == 0 or v == 0:
        return ZERO if d == 0 else -mpmath.inf, ZERO
    u = (mpmath.mpf(d) * s) ** 2 / (2 * v)
    return -u, 2 * u * positive / v


def log_opacity(logit: float) -> Any:
    return ZERO if logit == math.inf else -mpmath.log1p(mpmath.exp(-mpmath.mpf(logit)))


def reference_extinction(logit: float, sigma: float, d: float, tau: float, eps: float) -> Any:
    upper = mpmath.exp(log_opacity(logit)) / mpmath.mpf(tau)
    v = max(mpmath.mpf(sigma), ZERO) ** 2 + mpmath.mpf(eps) / 2
    if d == 0 or v == 0:
        return upper if d == 0 else ZERO
    return upper * mpmath.exp(-mpmath.lambertw((upper * d) ** 2 / v).real / 2)


@pytest.mark.parametrize(("eps", "scale", "dtype"), paired(EPSILONS, SCALES))
def test_opacities_and_their_gradients_match_mpmath(dtype: torch.dtype, eps: float, scale: float) -> None:
    inputs = grid(LOGITS, SIGMAS, DISTANCES)
    logits, sigma, d = (t.to(dtype) for t in inputs)
    leaves = logits.requires_grad_(), sigma.requires_grad_()
    out = attenuate(logits, sigma, d, scale, config(eps=eps))
    by_logit, by_sigma = torch.autograd.grad(out.opacities.sum(), leaves, retain_graph=True)
    log_by_logit, log_by_sigma = torch.autograd.grad(out.log_opacities.sum(), leaves)
    values = inputs[0].tolist()
    factors = [reference(a, b, scale, eps) for a, b in zip(*(c.tolist() for c in inputs[1:]), strict=True)]
    logs = [log_opacity(a) + factor for a, (factor, _) in zip(values, factors, strict=True)]
    opacities = [mpmath.exp(x) for x in logs]
    transparency = [1 / (1 + mpmath.exp(mpmath.mpf(a))) for a in values]
    slopes = [ZERO if slope > torch.finfo(dtype).max else slope for _, slope in factors]
    # exp turns u's error into a relative one; from float32's inputs u is float64's until after it.
    soft = [4 + 3 * float(min(-factor, 1e4)) if dtype == torch.float64 else 4.0 for factor, _ in factors]
    assert_close(out.log_opacities.detach(), logs, 4)
    assert_close(out.opacities.detach(), opacities, soft)
    assert_close(log_by_logit, transparency, 4)
    assert_close(log_by_sigma, slopes, 4)
    assert_close(by_logit, [a * t for a, t in zip(opacities, transparency, strict=True)], soft)
    # Where a'' itself is denormal its product with a steep slope has that error and no other.
    floors = [float(4 * torch.finfo(dtype).tiny * s) for s in slopes]
    assert_close(by_sigma, [a * s for a, s in zip(opacities, slopes, strict=True)], soft, floors)


@each_dtype
@pytest.mark.parametrize("scale", SCALES[1:3])
def test_what_the_soft_cut_draws_matches_mpmath(dtype: torch.dtype, scale: float) -> None:
    tau = 0.02
    inputs = grid([-3.7, -3.1, -1.6, *LOGITS], [*SIGMAS, 0.2, 0.6], [*DISTANCES, 0.15])
    logits, sigma, d = (t.to(dtype) for t in inputs)
    out = attenuate(logits.requires_grad_(), sigma.requires_grad_(), d, scale, config(tau, cut="soft"))
    by_logit, by_sigma = torch.autograd.grad(out.drawn.sum(), (logits, sigma))
    want, floors, slopes, transparency = [], [], [], []
    for a, b, c in zip(*(x.tolist() for x in inputs), strict=True):
        factor, slope = reference(b, c, scale, 1e-8)
        log = log_opacity(a) + factor
        ratio = mpmath.exp(log) / (mpmath.mpf(tau) * scale)
        want.append(mpmath.exp(log) * min(max(2 * (ratio - 1), ZERO), 1))
        # By log a'', where there is a slope: below 1.5 tau s the fade's own part is added to that of a''.
        inside = 1 < ratio < 1.5
        slopes.append((slope, mpmath.exp(log) * (4 * ratio - 2 if inside else ratio >= 1.5)))
        transparency.append(1 / (1 + mpmath.exp(mpmath.mpf(a))))
        # The threshold's distance is a difference of logarithms, whose rounding the fade triples.
        floors.append(float(mpmath.exp(log)) * 4 * (8 + float(min(abs(log), 1e4))) * torch.finfo(dtype).eps)
    assert_close(out.drawn.detach(), want, 8, floors)
    gained = [2 * floor for floor in floors]
    assert_close(by_logit, [s * t for (_, s), t in zip(slopes, transparency, strict=True)], 12, gained)
    by_slope = [f * float(k) for f, (k, _) in zip(gained, slopes, strict=True)]
    assert_close(by_sigma, [k * s for k, s in slopes], 20, by_slope)
    assert any(0 < g < 1 for g in (out.drawn / out.opacities).nan_to_num().tolist())


@each_cut
@each_dtype
def test_what_is_kept_is_what_is_drawn(dtype: torch.dtype, cut: str) -> None:
    """Of Gaussians that stand at the threshold, to 64 roundings of s."""
    generator = torch.Generator().manual_seed(0)
    logits, d = (torch.rand(20_000, generator=generator, dtype=dtype) for _ in range(2))
    for s in (1.0, 3.3):
        chosen = config(0.02, cut=cut)
        extinction = s * (1 + torch.linspace(-64, 64, len(d), dtype=dtype) * torch.finfo(dtype).eps)
        at = (8 * logits - 2, sigma_for_extinction(8 * logits - 2, d, extinction, chosen), d)
        out = attenuate(*at, s, chosen)
        assert 0.05 < out.keep.float().mean() < 0.95
        assert torch.equal(out.drawn > 0, out.keep)


@each_dtype
def test_identity_is_bit_exact(dtype: torch.dtype) -> None:
    logits = torch.cat([torch.linspace(-120, 60, 4001), torch.tensor([math.inf, -math.inf])]).to(dtype)
    d, most = torch.linspace(0, 1.5, len(logits)).to(dtype), torch.full_like(logits, SIGMA_MAX)
    widest = torch.full_like(d, 2e5 if dtype == torch.float32 else 10.0)
    cases = [(most, d, 6.0, 1e-8), (d - 0.7, torch.zeros_like(d), 6.0, 0.0), (most, widest, 1.0, 0.0)]
    for sigma, distances, s, eps in cases:
        assert torch.equal(attenuate(logits, sigma, distances, s, config(eps=eps)).opacities, logits.sigmoid())


@pytest.mark.parametrize("eps", [0.0, 1e-100, 1e-8])
@each_dtype
def test_edges_are_never_nan(dtype: torch.dtype, eps: float) -> None:
    edge = [0.0, 1e-45, 1e-30, 1e-12, 1.0, 1e12, 1e30]
    rows = itertools.product([*LOGITS, -math.inf, -1e4, -1e30], [*edge, -1.0, -1e30], edge)
    logits, sigma, d = torch.tensor([*rows], dtype=dtype).unbind(1)
    leaves, chosen = (logits.requires_grad_(), sigma.requires_grad_()), config(eps=eps)
    out, scales = attenuate(logits, sigma, d, 7.0, chosen), extinction_scale(logits, sigma, d, chosen)
    count = soft_count(out.log_opacities, 7.0, 1 / 255, 0.1)
    results = [*out[:4], count, scales, sigma_for_extinction(logits, d, d, chosen)]
    for loss in (out.opacities.sum(), count, out.log_opacities.sum()):
        results += torch.autograd.grad(loss, leaves, retain_graph=True)
    nothing = torch.autograd.grad(out.log_opacities, leaves, torch.zeros_like(d), retain_graph=True)
    assert not any(r.isnan().any() for r in results)
    assert all((r == 0).all() for r in nothing)
    gone = (sigma <= 0) & (d > 0) & (eps == 0)
    assert (out.log_opacities[gone] == -math.inf).all() and (scales[gone] == 0).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype) -> None:
    logits, sigma, d = (torch.linspace(a, b, 50).to(dtype) for a, b in ((-4, 4), (0.01, 1), (0, 1)))
    out = attenuate(logits, sigma.requires_grad_(), d, 3.0, config())
    want = attenuate(logits.float(), sigma.float(), d.float(), 3.0, config())
    assert out.opacities.dtype == torch.float32 and torch.equal(out.opacities, want.opacities)
    (grad,) = torch.autograd.grad(out.opacities.sum(), sigma)
    assert grad.dtype == dtype and grad.isfinite().all()


@each_cut
@each_dtype
def test_activated_opacities_give_what_their_logits_do(cut: str, dtype: torch.dtype) -> None:
    logits, sigma, d = (column.to(dtype) for column in grid(LOGITS, SIGMAS, DISTANCES))
    for scale in SCALES:
        chosen = config(0.3 / scale, cut=cut)
        want = attenuate(logits, sigma, d, scale, chosen)
        got = attenuate(logits.sigmoid(), sigma, d, scale, chosen, activated=True)
        assert torch.equal(got.opacities, want.opacities) and torch.equal(got.keep, want.keep)
        # The fade is a difference of logarithms, which differ by their rounding.
        torch.testing.assert_close(got.drawn, want.drawn, rtol=0, atol=8 * torch.finfo(dtype).eps)


@each_cut
def test_gradients_of_activated_opacities(cut: str) -> None:
    """By hand at 0 and 1, where logits are infinite."""
    ends = torch.tensor([0.0, 1.0, 0.0, 1.0], dtype=torch.float64, requires_grad=True)
    reach = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    d = torch.tensor([0.5, 0.5, 0.0, 0.0], dtype=torch.float64)
    found = attenuate(ends, reach, d, 1.0, config(0.02, cut=cut), activated=True).drawn
    assert (found > 0).tolist() == [False, True, False, True]
    slope_a, slope_sigma = (slope.tolist() for slope in torch.autograd.grad(found.sum(), [ends, reach]))
    factor = math.exp(-0.125)
    assert slope_a == pytest.approx([0, factor, 0, 1]) and slope_sigma == pytest.approx([0, factor / 4, 0, 0])


@pytest.mark.parametrize(("eps", "tau", "dtype"), paired(EPSILONS, TAUS))
def test_extinction_scale_matches_mpmath(dtype: torch.dtype, eps: float, tau: float) -> None:
    inputs = grid(LOGITS, SIGMAS, DISTANCES)
    got = extinction_scale(*(t.to(dtype) for t in inputs), config(tau, eps))
    rows = list(zip(*(c.tolist() for c in inputs), strict=True))
    want = [reference_extinction(*row, tau, eps) for row in rows]
    allowed = [6 + float(abs(log_opacity(row[0])) + abs(mpmath.log(tau))) for row in rows]
    assert_close(got, want, allowed, floor=torch.finfo(dtype).tiny / tau)


@pytest.mark.parametrize(("eps", "tau", "dtype"), paired(EPSILONS, TAUS))
def test_sigma_for_extinction_matches_mpmath(dtype: torch.dtype, eps: float, tau: float) -> None:
    inputs = grid(LOGITS[2:], DISTANCES, [0.0, 1e-6, 0.3, 1.0, 1.75, 1.999, 6.0, 100.0, 1e4])
    got = sigma_for_extinction(*(t.to(dtype) for t in inputs), config(tau, eps)).double()
    info = torch.finfo(dtype)
    for row, g in zip(zip(*(c.tolist() for c in inputs), strict=True), got.tolist(), strict=True):
        logit, d, s = row
        drop = log_opacity(logit) - mpmath.log(tau * mpmath.mpf(s)) if s > 0 else mpmath.inf
        if abs(drop) < 1e-14:
            continue  # s* is a/tau to rounding: both answers are right
        if drop < 0:
            assert g == float(torch.tensor(SIGMA_MAX, dtype=dtype)), row
            continue
        total = (mpmath.mpf(d) * s) ** 2 / (2 * drop)
        want = min(mpmath.sqrt(max(total - mpmath.mpf(eps) / 2, ZERO)), mpmath.mpf(SIGMA_MAX))
        # In float64, but for the last rounding: its condition is nothing beside float32's eps.
        logs = abs(log_opacity(logit)) + abs(mpmath.log(tau * mpmath.mpf(s))) + 1 if s > 0 else ZERO
        condition = 4 + float(logs / drop) * torch.finfo(torch.float64).eps / info.eps
        error = abs(mpmath.mpf(g) ** 2 - want**2)
        assert error <= condition * info.eps * max(total, mpmath.mpf(eps) / 2) + info.tiny, (row, g, want)


@each_dtype
@pytest.mark.parametrize(("scale", "reach"), [*zip(SCALES, [1e-3, 0.3, 1.0, 4.2], strict=True), (7.0, 1e-3)])
def test_growth_and_its_slope_match_mpmath(dtype: torch.dtype, scale: float, reach: float) -> None:
    h, d = (column.to(dtype) for column in grid(EXPONENTS, [*DISTANCES, 1.0000001, 5e3]))
    out = growth_factors(h.requires_grad_(), d, scale, reach)
    (slope,) = torch.autograd.grad(out.sum(), h)
    want, slopes, allowed, of_slopes = [], [], [], []
    for a, b in zip(h.tolist(), d.tolist(), strict=True):
        log_m = max(mpmath.log(mpmath.mpf(b) * scale / mpmath.mpf(reach)), ZERO) if b else ZERO
        log_g = a * log_m
        clamped = min(max(log_g, -LOG_GROWTH_MAX), LOG_GROWTH_MAX)
        want.append(mpmath.exp(clamped))
        slopes.append(mpmath.exp(log_g) * log_m if clamped == log_g else ZERO)
        allowed.append(4 + 2 * abs(a) * (1 + float(log_m)))  # of the docstring of ``growth``
        of_slopes.append(allowed[-1] + 2 / max(float(log_m), 1e-9))
    assert_close(out.detach(), want, allowed)
    assert_close(slope, slopes, of_slopes)
    assert sum(g > 1 for g in want) > 5


@each_dtype
def test_growth_is_finite(dtype: torch.dtype) -> None:
    """At any finite exponent, at the centre, at distances and dial values whose product overflows."""
    largest = torch.finfo(dtype).max
    edges = itertools.product([0.0, -0.0, 1e-30, 1.0, -1.0, largest, -largest], [0.0, 1e-40, 1.0, 1e30, largest])
    h, d = torch.tensor([*edges], dtype=dtype).unbind(1)
    h.requires_grad_()
    for s, r in itertools.product([1.0, 5.0, 1e39, 1e300], [1e-300, 1e-3, 1.0, 1e300]):
        out = growth_factors(h, d, s, r)
        (slope,) = torch.autograd.grad(out.sum(), h)
        assert out.isfinite().all() and slope.isfinite().all()
        assert (out >= 0.99 * math.exp(-20)).all() and (out <= 1.01 * math.exp(20)).all()
        assert (out[(h == 0) | (d == 0)] == 1).all()


def test_bad_calls_are_named() -> None:
    three, four = torch.ones(3), torch.ones(4)
    assert attenuate(three, None, three, 2.0, None, growth_d=three).growth.tolist() == [1, 1, 1]
    with pytest.raises(ClodError, match="virtual_scale is -0.5"):
        attenuate(three, three, three, -0.5, config())
    with pytest.raises(ClodError, match=r"sigma_d \(4,\)"):
        extinction_scale(three, four, three, config())
    with pytest.raises(ClodError, match="sigma_d is no tensor but ndarray; pass torch.as_tensor of it"):
        attenuate(three, three.numpy(), three, 2.0, config())
    for seen_from in (three, (torch.ones(3, 3), camera())):
        with pytest.raises(ClodError, match=r"growth_d \(1,\)"):
            attenuate(three, three, seen_from, 2.0, config(), growth_d=torch.ones(1))
