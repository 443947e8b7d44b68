"""The CPU's kernels have the dial in them: they draw, keep and differentiate what the default
``draw`` composes, and what the reference does in float64.
"""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from backends import torch_threads
from clod_adapter.config import FORMS, ScreenFilter
from clod_adapter.equation.attenuation import SIGMA_MAX, dial
from clod_adapter.rasterizers import Rasterizer, cpu, for_device, reference
from scenes import attenuated, camera, gaussians, seeded

VIEW = camera(45, 37)
KERNELS, COMPOSED = for_device(torch.device("cpu")), Rasterizer(cpu.rasterize)
EXACT = Rasterizer(reference.rasterize)
SHAPE, COLOUR = ("means", "quats", "log_scales", "growth_d"), ("sh0", "shN")


def results(rasterizer, model, s, *frozen):
    """Image and alpha, and the gradients of a random weighting of them, by attribute."""
    random = seeded(3)
    leaves = {
        name: x.clone().requires_grad_(name not in frozen) for name, x in model.tensors().items()
    }
    leaves["background"] = torch.tensor([0.2, 0.4, 0.6]).to(model.means).requires_grad_()
    drawn = {name: x for name, x in leaves.items() if name != "background"}
    image, alpha = rasterizer.draw(model.replace(**drawn), VIEW, s, background=leaves["background"])
    weighed = sum((x * torch.rand(x.shape, generator=random)).sum() for x in (image, alpha))
    asked = {name: x for name, x in leaves.items() if x.requires_grad}
    slopes = torch.autograd.grad(weighed, list(asked.values()))
    return image.detach(), alpha.detach(), dict(zip(asked, slopes, strict=True))


def away_from_thresholds(model, s):
    """Without rows that rounding may cull, or draw with less than 1/255."""
    sure = (dial(model, VIEW, s).drawn - 1 / 255).abs() > 1e-5
    return model.select(
        sure & (dial(model, VIEW, s * 0.99999).keep == dial(model, VIEW, s * 1.00001).keep)
    )


def assert_same(model, s, *frozen):
    model = away_from_thresholds(model, s)
    *pictures, slopes = results(KERNELS, model, s, *frozen)
    double = model.replace(**{name: x.double() for name, x in model.tensors().items()})
    for rasterizer, exact in ((COMPOSED, model), (EXACT, double)):
        *wanted, want = results(rasterizer, exact, s, *frozen)
        for found, expected in zip(pictures, wanted, strict=True):  # an alpha of 1/255 more or less
            torch.testing.assert_close(found, expected, rtol=0, atol=5e-3, check_dtype=False)
            assert found.numel() == 0 or float((found - expected).abs().mean()) < 3e-5
        for name, expected in want.items():  # one pixel with 1/255 more or less changes a few
            assert (
                float((slopes[name] - expected).norm()) <= 5e-3 * float(expected.norm()) + 1e-6
            ), name
        kept = KERNELS.kept(model, VIEW, s)
        assert torch.equal(kept, rasterizer.kept(exact, VIEW, s)) and kept.dtype == torch.bool
    return slopes


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, 33, 200])
def test_counts_around_sixteen(n):
    with torch_threads(3):
        slopes = assert_same(attenuated(n, 2, n).replace(growth_d=torch.linspace(-1, 2, n)), 2.0)
    assert n < 33 or all(bool(slope.any()) for slope in slopes.values())


@settings(max_examples=20, deadline=None)
@given(
    s=st.sampled_from([0.0, 1.0, 1.7, 6.0, 40.0]),
    form=st.sampled_from(FORMS),
    grows=st.booleans(),
    seed=st.integers(0, 99),
    reference=st.sampled_from([0.0, 2.0]),
    mip=st.booleans(),
)
def test_any_settings(grows, s, seed, reference, mip, form):
    model = attenuated(90, 0, seed, reference_distance=reference, max_sv=45.0, form=form)
    model = model.replace(screen_filter=ScreenFilter(compensate=mip))
    if grows:
        model = model.replace(growth_d=torch.linspace(-1, 1.5, 90).roll(seed))
    assert_same(model, s)


def test_the_end_of_the_reach():
    """Gaussians at 0.9 to 1.01 of their reaches; and which are kept, to the rounding of float32."""
    model = attenuated(3000, 0, 5)
    far = (model.means - VIEW.position).norm(dim=1) * 2 / 3
    faint = model.replace(sigma_d=far / torch.linspace(0.9, 1.01, 3000))[::10]
    assert (
        0.8 < KERNELS.kept(faint, VIEW, 2.0).float().mean() < 0.95
        and assert_same(faint, 2.0)["sigma_d"].any()
    )
    share = 1 + torch.linspace(-1e-5, 1e-5, 3000)
    kept = KERNELS.kept(model.replace(sigma_d=far / share), VIEW, 2.0)
    sure = (share - 1).abs() > 1e-6
    assert torch.equal(kept[sure], (share < 1)[sure])


def test_frozen_attributes_and_models_without_a_dial():
    model = attenuated(120, 1, 4).replace(growth_d=torch.full((120,), 0.5))
    for frozen in (SHAPE, COLOUR, (*SHAPE, *COLOUR), ("sigma_d", "opacity_logits"), SHAPE[:3]):
        assert_same(model, 2.0, *frozen)
    assert_same(gaussians(100, 2, 0), 3.0)
    assert_same(gaussians(100, 0, 0).replace(screen_filter=ScreenFilter(compensate=True)), 1.0)


def test_extreme_values():
    """Sigma, opacities and growth at their limits, and a Gaussian in the camera's centre."""
    sigmas = [0.0, -1.0, 1e-30, 1e-4, 1.0, SIGMA_MAX, 1e30, math.inf]
    logits, growths = (
        [-math.inf, -200.0, -4.0, 0.0, 3.0, 90.0, math.inf],
        [-1e30, -5.0, 0.0, 1.0, 30.0, 1e30],
    )
    rows = torch.cartesian_prod(*(torch.tensor(x) for x in (sigmas, logits, growths)))
    for s in (0.0, 1.0, 5.0):
        model = attenuated(len(rows), 0, 3).replace(sigma_d=rows[:, 0], opacity_logits=rows[:, 1])
        model.means[::7] = VIEW.position
        model = model.replace(growth_d=rows[:, 2])
        for x in KERNELS.draw(model, VIEW, s):
            assert x.isfinite().all()
        usual = (rows[:, 2].abs() < 10) & (rows[:, 1] > -100) & (torch.arange(len(rows)) % 7 > 0)
        some = away_from_thresholds(model.select(usual), s)
        kept = [each.kept(some, VIEW, s) for each in (KERNELS, COMPOSED)]
        assert torch.equal(*kept) and bool(kept[0].all()) == (s == 0)
        image, alpha, slopes = results(KERNELS, model.select(usual), s)
        assert all(x.isfinite().all() for x in (image, alpha, *slopes.values()))


@pytest.mark.parametrize("rasterizer", [KERNELS, COMPOSED], ids=["kernels", "composed"])
def test_a_row_with_infinite_sigma_has_no_dial(rasterizer):
    """It is drawn as without a dial, however far the dial is turned, and its opacity has that
    gradient.
    """
    model = gaussians(60, 0, 1)
    fixed = attenuated(60, 0, 1, max_sv=45.0).replace(
        sigma_d=torch.full((60,), math.inf), growth_d=torch.zeros(60)
    )
    image, alpha, slopes = results(rasterizer, fixed, 40.0)
    wanted, want_alpha, want = results(rasterizer, model, 1.0)
    assert torch.equal(image, wanted) and torch.equal(alpha, want_alpha)
    for name, value in want.items():
        torch.testing.assert_close(slopes[name], value)
    assert not slopes["sigma_d"].any() and bool(want["opacity_logits"].any())
    assert bool(rasterizer.kept(fixed, VIEW, 40.0).all())


def test_distances_of_another_camera_and_a_growth_that_is_not_finite():
    model, other = attenuated(50, 0, 1), camera(45, 37, fov=70)
    found = [each.draw(model, VIEW, 2.0, seen_from=other)[0] for each in (KERNELS, COMPOSED)]
    assert torch.equal(*found)
    assert (
        KERNELS.draw(model.replace(growth_d=torch.full((50,), math.nan)), VIEW, 2.0)[1].sum() == 0
    )


def test_gradients_beyond_the_trained_rows_are_0():
    model = away_from_thresholds(attenuated(90, 1, 2).replace(growth_d=torch.full((90,), 0.5)), 2.0)
    want, leaves = (
        results(KERNELS, model, 2.0)[2],
        {k: x.clone().requires_grad_() for k, x in model.tensors().items()},
    )
    image, _ = KERNELS.draw(model.replace(**leaves), VIEW, 2.0, trained=40)
    for name, slope in zip(
        leaves, torch.autograd.grad(image.sum(), list(leaves.values())), strict=True
    ):
        assert not slope[40:].any() and bool(slope[:40].any()) == bool(want[name][:40].any()), name
