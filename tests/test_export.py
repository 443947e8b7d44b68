"""Baking: the plain Gaussians look, at the distance they are baked for, as the dial shows them there."""

from __future__ import annotations

import math

import pytest
import torch

from clod_adapter.adapter import attach
from clod_adapter.attenuation import attenuate
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.export import bake
from clod_adapter.gaussians import Gaussians
from clod_adapter.render import render
from scenes import camera, gaussians

CONFIG = AttenuationConfig(scene_distance=4.0)


def sphere(n: int = 200) -> Gaussians:
    """All at the reference distance from ``camera()``, the only place for which a bake is exact."""
    some, eye = gaussians(n, 1, 5), camera().position
    away = some.means - eye
    sigma = torch.rand(n, generator=torch.Generator().manual_seed(1)) * 2 + 0.1
    return attach(some.replace(means=eye + 4.0 * away / away.norm(dim=1, keepdim=True)), sigma, CONFIG)


@pytest.mark.parametrize("s", [1.0, 2.0, 4.5])
def test_the_same_picture_at_the_reference_distance(s: float) -> None:
    some = sphere()
    want, baked = render(some, camera(), s), bake(some, s)
    assert baked.sigma_d is None and baked.attenuation is None and 0 < len(baked) < 200
    assert len(baked) == want.kept.sum()
    torch.testing.assert_close(render(baked, camera()).image, want.image, atol=2e-5, rtol=0)


def test_opacities_are_the_attenuated_ones() -> None:
    logits = torch.tensor([-3.0, 0, 8, 30, math.inf, math.inf])
    sigma = torch.tensor([2.0, 2, 2, 2, 2, 1e9])
    some = attach(gaussians(6, 0, 0).replace(opacity_logits=logits), sigma, CONFIG)
    want = attenuate(logits, sigma, torch.ones(6), 2.0, CONFIG)
    baked = bake(some, 2.0)
    assert len(baked) == 6 and baked.opacity_logits.isfinite().all()
    torch.testing.assert_close(baked.opacities, want.opacities, atol=1e-7, rtol=2e-6)


def test_a_dial_that_does_nothing_changes_nothing() -> None:
    some = gaussians(50, 0, 1)
    baked = bake(attach(some), 1.0)
    assert torch.equal(baked.opacity_logits, some.opacity_logits[some.opacities > 1 / 255])


def test_bad_calls_are_named() -> None:
    with pytest.raises(ClodError, match="no sigma_d"):
        bake(gaussians(3, 0, 0), 1.0)
    with pytest.raises(ClodError, match="virtual_scale is 0.5"):
        bake(sphere(), 0.5)
    with pytest.raises(ClodError, match="no Gaussian is kept at s = 200"):
        bake(sphere(), 200.0)
