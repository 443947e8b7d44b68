"""The gradient of the dial in the projection's kernel, compared with that of the equation and the plain rasterizer."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from backends import torch_threads
from clod_adapter.config import ScreenFilter
from clod_adapter.equation.attenuation import SIGMA_MAX, dial
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers import Rasterizer, cpu
from clod_adapter.render import render
from scenes import camera, dialled, gaussians

VIEW = camera(45, 37)
BEHIND = torch.tensor([0.2, 0.4, 0.6])


def gradients(model: Gaussians, s: float, rasterizer: Rasterizer | None, *frozen: str) -> dict[str, Tensor]:
    """Of a random weighting of image and alpha, by attribute."""
    random = torch.Generator().manual_seed(3)
    leaves = {name: x.clone().requires_grad_(name not in frozen) for name, x in model.tensors().items()}
    behind = BEHIND.clone().requires_grad_()
    found = render(model.replace(**leaves), VIEW, s, background=behind, rasterizer=rasterizer)
    weighed = (found.image * torch.rand(found.image.shape, generator=random)).sum()
    weighed = weighed + (found.alpha * torch.rand(found.alpha.shape, generator=random)).sum()
    asked = {name: x for name, x in {**leaves, "behind": behind}.items() if x.requires_grad}
    return dict(zip(asked, torch.autograd.grad(weighed, list(asked.values())), strict=True))


def assert_same(model: Gaussians, s: float, *frozen: str) -> dict[str, Tensor]:
    at_once, apart = gradients(model, s, None, *frozen), gradients(model, s, Rasterizer(cpu.rasterize), *frozen)
    for name, want in apart.items():
        largest = max(float(want.abs().max()), 1e-6) if want.numel() else 1.0
        torch.testing.assert_close(
            at_once[name], want, rtol=1e-3, atol=1e-4 * largest, msg=lambda m, n=name: f"{n}: {m}"
        )
    return at_once


def away_from_the_threshold(model: Gaussians, s: float) -> Gaussians:
    """Without rows that rounding may cull, or draw with less than 1/255."""
    found = dial(model, VIEW, s)
    assert model.attenuation is not None
    threshold = math.log(model.attenuation.tau * s)
    return model.select(((found.log_opacities - threshold).abs() > 1e-4) & ((found.drawn - 1 / 255).abs() > 1e-5))


@pytest.mark.parametrize("n", [1, 15, 16, 17, 33, 200])
@pytest.mark.parametrize("workers", [1, 3])
def test_counts_around_sixteen(n: int, workers: int) -> None:
    with torch_threads(workers):
        model = dialled(n, 2, n).replace(growth_d=torch.linspace(-1, 2, n))
        found = assert_same(away_from_the_threshold(model, 2.0), 2.0)
    assert n < 33 or all(bool(found[name].any()) for name in found)


@settings(max_examples=25, deadline=None)
@given(
    s=st.sampled_from([1.0, 1.7, 6.0, 40.0]), cut=st.sampled_from(["soft", "hard"]), eps=st.sampled_from([0.0, 1e-8]),
    tau=st.sampled_from([1e-6, 1 / 255, 0.02]), grows=st.booleans(), seed=st.integers(0, 99),
    normalizer=st.sampled_from(["scene", "max"]), reference=st.sampled_from([0.0, 2.0]), mip=st.booleans(),
)  # fmt: skip
def test_any_settings(grows: bool, s: float, seed: int, reference: float, mip: bool, **given: Any) -> None:
    model = dialled(90, 0, seed, reference_distance=reference, max_sv=45.0, **given)
    model = model.replace(screen_filter=ScreenFilter(compensate=mip))
    if grows:
        model = model.replace(growth_d=torch.linspace(-1, 1.5, 90).roll(seed))
    assert_same(away_from_the_threshold(model, s), s)


def test_frozen_attributes() -> None:
    model = away_from_the_threshold(dialled(120, 1, 4).replace(growth_d=torch.full((120,), 0.5)), 2.0)
    shape, colour = ("means", "quats", "log_scales", "growth_d"), ("sh0", "shN")
    for frozen in (shape, colour, (*shape, *colour), ("sigma_d", "opacity_logits"), ("means", "quats", "log_scales")):
        assert_same(model, 2.0, *frozen)


def test_without_a_dial() -> None:
    assert_same(gaussians(100, 2, 0), 3.0)


def test_extreme_values_have_finite_gradients() -> None:
    sigmas, logits = [0.0, -1.0, 1e-30, 1e-4, 1.0, SIGMA_MAX, math.inf], [-200.0, -4.0, 0.0, 90.0, math.inf]
    rows = torch.cartesian_prod(*(torch.tensor(x) for x in (sigmas, logits, [-5.0, 0.0, 3.0, 30.0])))
    for eps in (0.0, 1e-8):
        model = dialled(len(rows), 0, 3, eps=eps).replace(sigma_d=rows[:, 0], opacity_logits=rows[:, 1])
        model.means[::7] = VIEW.position
        for name, gradient in gradients(model.replace(growth_d=rows[:, 2]), 2.0, None).items():
            assert gradient.isfinite().all(), name


def test_a_row_with_infinite_sigma_has_no_dial() -> None:
    """It is drawn as without a dial, however far the dial is turned, and its opacity has that gradient."""
    model = gaussians(60, 0, 1)
    fixed = dialled(60, 0, 1, max_sv=45.0).replace(sigma_d=torch.full((60,), math.inf), growth_d=torch.zeros(60))
    assert torch.equal(render(fixed, VIEW, 40.0).image, render(model, VIEW).image)
    found, want = gradients(fixed, 40.0, None), gradients(model, 1.0, None)
    for name, value in want.items():
        torch.testing.assert_close(found[name], value)
    assert not found["sigma_d"].any() and bool(want["opacity_logits"].any())
    assert bool(cpu.RASTERIZER.kept(fixed, VIEW, 40.0).all())


@pytest.mark.parametrize("workers", [1, 3])
def test_kept_rows(workers: int) -> None:
    for n in (1, 16, 17, 300):
        model = dialled(n, 0, n)
        for s in (1.0, 3.0):
            with torch_threads(workers):
                got, want = cpu.RASTERIZER.kept(model, VIEW, s), dial(model, VIEW, s).keep
            assert got.dtype == torch.bool and int((got != want).sum()) <= 1
    assert 0 < int(got.sum()) < 300
