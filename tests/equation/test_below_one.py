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


def test_a_budget_that_s_1_does_not_use_up_is_met_below_1(own: clod.Gaussians) -> None:
    at_1 = attenuate(own.opacity_logits, own.sigma_d, (own.means, camera()), 1.0, own.attenuation).keep
    wanted = (int(at_1.sum()) + len(own)) // 2
    found = dial_for(own, keep=wanted, cameras=[camera()]).virtual_scale
    assert 0 < found < 1
    kept = attenuate(own.opacity_logits, own.sigma_d, (own.means, camera()), found, own.attenuation).keep
    assert int(kept.sum()) == pytest.approx(wanted, abs=2)
    assert dial_for(own, keep=len(own), cameras=[camera()]).virtual_scale == 0


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_other_dial_values_are_refused(own: clod.Gaussians, bad: float) -> None:
    with pytest.raises(clod.ClodError, match="virtual_scale is .* must be at least 0 and finite"):
        clod.render(own, camera(), bad)
