"""The equation and growth against mpmath at 50 digits, and the properties the dial stands on; the
paper's form.
"""

import itertools
import math
import os

import mpmath
import pytest
import stability_equation
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from clod_adapter import AttenuationConfig
from clod_adapter.equation.attenuation import SIGMA_MAX, attenuate, growth_factors
from clod_adapter.equation.paper import EPS, TAU, soft_count
from scenes import camera, seeded

DTYPES = [torch.float32, torch.float64]
LOGITS = [-200.0, -40.0, -6.0, -1.0, 0.0, 2.0, 9.0, 200.0, math.inf]
SIGMAS = [-1.0, 0.0, 1e-12, 1e-3, 0.4, 1.0, 30.0, 1e6, SIGMA_MAX]
DISTANCES = [0.0, 1e-7, 1e-3, 0.1, 0.7, 1.5]
SCALES = [1.0, 1.75, 7.0, 1e4]
OURS, PAPER = AttenuationConfig(), AttenuationConfig(form="paper")

mpmath.mp.dps = 50
mpf, ZERO, ONE = mpmath.mpf, mpmath.mpf(0), mpmath.mpf(1)
each_dtype = pytest.mark.parametrize("dtype", DTYPES)


def grid(dtype, *axes):
    """Columns of the axes' product."""
    return list(torch.tensor(list(itertools.product(*axes)), dtype=dtype).unbind(1))


def assert_close(got, want, allowed):
    """Errors within ``allowed`` times the wanted value, or the smallest normal."""
    tiny = torch.finfo(got.dtype).tiny
    for i, (g, w) in enumerate(zip(got.tolist(), want, strict=True)):
        assert abs(mpf(g) - w) <= max(allowed[i] * abs(w), tiny), (i, g, w)


def opacity(logit):
    return ONE if logit == math.inf else 1 / (1 + mpmath.exp(-mpf(logit)))


def test_errors_are_within_the_bounds_that_the_module_states():
    """Drawn opacities, growth and their gradients on the benchmark's random inputs, over all
    magnitudes and from far inside the reach to just beyond it. Where ``other_libm`` moves the
    elementary functions by an ulp, half as much again is allowed.
    """
    moved = "OTHER_LIBM" in os.environ
    rows = stability_equation.measure()
    assert len(rows) == len(DTYPES) * len(stability_equation.BOUNDS)
    for row in rows:
        assert row["failed"] == 0 or (moved and row["worst_of_bound"] < 1.5), row
        assert row["nan"] == 0 and row["points"] > 9000, row


@each_dtype
def test_a_reach_ends_where_the_distance_equals_it(dtype):
    """Whatever the opacity; what is kept is drawn with more than 0."""
    reach = torch.rand(20_000, generator=seeded(0), dtype=dtype) + 0.1
    for factor, inside in (
        (1 - torch.finfo(dtype).eps, True),
        (1, False),
        (1 + torch.finfo(dtype).eps, False),
    ):
        for opacities in (
            torch.zeros_like(reach),
            torch.full_like(reach, 1e-3),
            torch.ones_like(reach),
        ):
            out = attenuate(opacities, reach, reach / 4 * factor, 4.0, OURS, activated=True)
            assert (out.keep == inside).all() and torch.equal(
                out.drawn > 0, out.keep & (opacities > 0)
            )


positive = st.floats(1e-3, 1e3)


@settings(deadline=None, max_examples=50)
@given(
    s=positive,
    d=positive,
    turned=st.floats(1, 10),
    away=st.floats(1, 10),
    dtype=st.sampled_from(DTYPES),
)
def test_what_is_drawn_is_nested_and_fades_evenly(s, d, turned, away, dtype):
    """Further away, or at a larger dial value, no Gaussian comes back or is stronger, and opacity
    changes by at most 4 a per unit of log s and log d. It ends at ``s* = sigma_d / d``.
    """
    sigma = torch.logspace(-7, 7, 2000, dtype=dtype)
    a = torch.linspace(0, 1, 2000, dtype=dtype).roll(700)
    near, far = (torch.full_like(sigma, value) for value in (d, d * away))
    before, after = (
        attenuate(a, sigma, *at, OURS, activated=True) for at in ((near, s), (far, s * turned))
    )
    assert not (after.keep & ~before.keep).any() and (after.drawn <= before.drawn).all()
    changed, eps = before.drawn - after.drawn, torch.finfo(dtype).eps
    assert (changed <= 4 * a * math.log(away * turned) + 8 * eps).all()
    ends = sigma / near
    sure = (ends / s - 1).abs() > 4 * eps
    assert torch.equal(before.keep[sure], (s < ends)[sure])


@each_dtype
def test_without_an_effect_the_dial_is_bit_exact(dtype):
    """At s = 0, at the camera's centre, with an infinite sigma_d, and with SIGMA_MAX nearer than
    its docstring says.
    """
    logits = torch.cat([torch.linspace(-120, 60, 4001), torch.tensor([math.inf, -math.inf])]).to(
        dtype
    )
    d, ones = torch.linspace(0, 1.5, len(logits), dtype=dtype), torch.ones_like(logits)
    widest = 1e7 if dtype == torch.float32 else 8e4
    for sigma, distances, s in (
        (d - 0.7, d, 0.0),
        (d - 0.7, 0 * d, 6.0),
        (math.inf * ones, d, 1e30),
        (SIGMA_MAX * ones, widest * d / 2, 1.3),
    ):
        found = attenuate(logits, sigma, distances, s, OURS)
        assert torch.equal(found.drawn, logits.sigmoid()) and found.keep.all()


@each_dtype
@pytest.mark.parametrize(
    ("config", "s"),
    [(OURS, 0.0), (OURS, 7.0), (OURS, 1e39), (OURS, 1e300), (PAPER, 0.0), (PAPER, 7.0)],
)
def test_edges_are_finite(dtype, config, s):
    """Values and gradients; of the paper's form, whose distances are shares of the largest, up to
    SIGMA_MAX.
    """
    tiny, largest = torch.finfo(dtype).tiny, torch.finfo(dtype).max
    sigmas = [0.0, tiny, 1e-30, 1e-12, 1.0, SIGMA_MAX, -1.0, -math.inf, 1e30, math.inf]
    distances = [0.0, tiny, 1e-30, 1e-12, 1.0, SIGMA_MAX, 1e30, largest]
    columns = grid(dtype, [*LOGITS, -math.inf, -1e4, -1e30], sigmas, distances)
    usable = (torch.stack(columns[1:]) <= (math.inf if config is OURS else SIGMA_MAX)).all(0)
    logits, sigma, d = (column[usable] for column in columns)
    out = attenuate(logits.requires_grad_(), sigma.requires_grad_(), d, s, config)
    slopes = torch.autograd.grad(out.drawn.sum(), (logits, sigma))
    assert all(x.isfinite().all() for x in (out.drawn, *slopes))
    assert (
        not out.drawn[~out.keep].any()
        and not out.keep[(d.double() * s > 0) & (sigma <= 0) & (config is OURS)].any()
    )


@pytest.mark.parametrize("activated", [False, True])
def test_gradients_are_those_of_differences(activated):
    """In float64; at opacities 0 and 1 too, of both forms, and of growth."""
    sigma, d, h = grid(
        torch.float64, [0.3, 0.9, 2.0, 40.0], [0.05, 0.21, 0.55, 3.0], [-0.5, 0.0, 1.5]
    )
    opacities = torch.linspace(*((0, 1) if activated else (-5, 9)), len(d), dtype=torch.float64)
    for config in (OURS, PAPER):

        def drawn(*given, config=config):
            found = attenuate(*given[:2], d, 1.5, config, activated=activated, growth_d=given[2])
            return found.drawn, found.growth

        inputs = tuple(x.clone().requires_grad_() for x in (opacities, sigma, h))
        assert torch.autograd.gradcheck(drawn, inputs)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype):
    logits, sigma, d = (
        torch.linspace(a, b, 50).to(dtype) for a, b in ((-6, 4), (0.01, 1), (0, 1.5))
    )
    for config in (OURS, PAPER):
        out = attenuate(logits, sigma.requires_grad_(), d, 1.3, config)
        want = attenuate(logits.float(), sigma.float(), d.float(), 1.3, config)
        assert out.drawn.dtype == torch.float32 and torch.equal(out.drawn, want.drawn)
        assert 0 < out.keep.sum() < 50
        (slope,) = torch.autograd.grad(out.drawn.sum(), sigma)
        assert slope.dtype == dtype and slope.isfinite().all()


@each_dtype
def test_activated_opacities_give_what_their_logits_do(dtype):
    logits, sigma, d = grid(dtype, LOGITS, SIGMAS, DISTANCES)
    for scale, config in itertools.product(SCALES, (OURS, PAPER)):
        want = attenuate(logits, sigma, d, scale, config)
        got = attenuate(logits.sigmoid(), sigma, d, scale, config, activated=True)
        assert torch.equal(got.drawn, want.drawn) and torch.equal(got.keep, want.keep)


@each_dtype
@pytest.mark.parametrize("scale", [1.0, 3.0, 40.0])
def test_the_papers_form_is_its_formula(dtype, scale):
    """Eq. 2 and the mask M_i: drawn with a'' where that is above TAU s, else culled."""
    logits, sigma, d = grid(dtype, LOGITS, SIGMAS[1:], DISTANCES)
    leaf = sigma.clone().requires_grad_()
    out = attenuate(logits, leaf, d, scale, PAPER)
    (slope,) = torch.autograd.grad(out.drawn.sum(), leaf)
    want, slopes, allowed = [], [], []
    for x, decay, distance, kept in zip(
        *(c.tolist() for c in (logits, sigma, d, out.keep)), strict=True
    ):
        v = 2 * mpf(decay) ** 2 + mpf(EPS)
        u = (mpf(distance) * mpf(scale)) ** 2 / v
        faded = opacity(x) * mpmath.exp(-u)
        assert kept == (faded > mpf(TAU) * scale) or abs(faded / (mpf(TAU) * scale) - 1) < 1e-5
        want.append(faded if kept else ZERO)
        slopes.append(want[-1] * 4 * mpf(decay) * u / v)
        allowed.append(6 * torch.finfo(dtype).eps + 4 * float(min(u, 100)) * 2**-52)
    assert 0 < out.keep.sum() < len(d)
    assert_close(out.drawn.detach(), want, allowed)
    assert_close(slope, slopes, allowed)
    count = soft_count(logits, leaf, d.double() * scale, scale, 0.5)
    assert count.item() == pytest.approx(out.keep.double().mean().item(), abs=1e-2 / len(d))
    assert all(x.isfinite().all() for x in torch.autograd.grad(count, leaf))


@each_dtype
def test_growth_is_finite(dtype):
    """At any finite exponent, at the centre, at distances and dial values whose product
    overflows.
    """
    largest = torch.finfo(dtype).max
    edges = itertools.product(
        [0.0, -0.0, 1e-30, 1.0, -1.0, largest, -largest], [0.0, 1e-40, 1.0, 1e30, largest]
    )
    h, d = torch.tensor([*edges], dtype=dtype).unbind(1)
    h.requires_grad_()
    for s, r in itertools.product([1.0, 5.0, 1e39, 1e300], [1e-300, 1e-3, 1.0, 1e300]):
        out = growth_factors(h, d, s, r)
        (slope,) = torch.autograd.grad(out.sum(), h)
        assert out.isfinite().all() and slope.isfinite().all()
        assert (out >= 0.99 * math.exp(-20)).all() and (out <= 1.01 * math.exp(20)).all()
        assert (out[(h == 0) | (d == 0)] == 1).all()


def test_bad_calls_are_named():
    three, four = torch.ones(3), torch.ones(4)
    assert attenuate(three, None, three, 2.0, None, growth_d=three).growth.tolist() == [1, 1, 1]
    with refused("virtual_scale is -0.5"):
        attenuate(three, three, three, -0.5, OURS)
    with refused(r"sigma_d \(4,\)"):
        attenuate(three, four, three, 2.0, OURS)
    with refused("sigma_d is no tensor but ndarray; pass torch.as_tensor of it"):
        attenuate(three, three.numpy(), three, 2.0, OURS)
    for seen_from in (three, (torch.ones(3, 3), camera())):
        with refused(r"growth_d \(1,\)"):
            attenuate(three, three, seen_from, 2.0, OURS, growth_d=torch.ones(1))
