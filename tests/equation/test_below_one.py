"""Dial values below 1: 0 shows everything as the file without its dial, and nothing jumps on the way to 1."""

from __future__ import annotations

import math

import pytest
import torch

import clod_adapter as clod
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.evaluation.budget import dial_for
from scenes import camera, dialled


@pytest.fixture(scope="module", params=["soft", "hard"])
def own(request: pytest.FixtureRequest) -> clod.Gaussians:
    found = dialled(400, 1, 3, cut=request.param)
    return found.replace(growth_d=torch.rand(400, generator=torch.Generator().manual_seed(0)))


def test_zero_is_the_file_without_its_dial(own: clod.Gaussians) -> None:
    all_of_it, plain = clod.render(own, camera(), 0.0), clod.render(clod.detach(own), camera())
    assert torch.equal(all_of_it.image, plain.image)
    shown = attenuate(own.opacity_logits, own.sigma_d, (own.means, camera()), 0.0, own.attenuation,
                           growth_d=own.growth_d)  # fmt: skip
    assert bool(shown.keep.all()) and torch.equal(shown.drawn, own.opacities) and bool((shown.growth == 1).all())


def test_the_dial_is_continuous_at_0_and_1_and_descends(own: clod.Gaussians) -> None:
    values = (0.0, 1e-4, 0.3, 0.6, 1 - 1e-4, 1.0, 1 + 1e-4, 2.0)
    faded = [attenuate(own.opacity_logits, own.sigma_d, (own.means, camera()), s, own.attenuation) for s in values]
    for nearer, farther in zip(faded, faded[1:], strict=False):
        assert bool((farther.opacities <= nearer.opacities).all()) and bool((farther.keep <= nearer.keep).all())
    if own.attenuation is not None and own.attenuation.cut == "soft":
        for k in (0, 4, 5):
            assert float((faded[k].drawn - faded[k + 1].drawn)[own.sigma_d > 0.05].abs().max()) < 2e-3


def test_budgets_stop_at_full_quality(own: clod.Gaussians) -> None:
    """Below 1 more is shown, but training was at s >= 1: the picture is no better."""
    assert dial_for(own, keep=len(own), cameras=[camera()]).virtual_scale == 1


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_other_dial_values_are_refused(own: clod.Gaussians, bad: float) -> None:
    with pytest.raises(clod.ClodError, match="virtual_scale is .* must be at least 0 and finite"):
        clod.render(own, camera(), bad)
