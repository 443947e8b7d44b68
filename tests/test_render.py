"""Rendering with and without a dial."""

import math

import pytest
import torch

from clod_adapter import AttenuationConfig, ClodError, detach, with_dial
from clod_adapter.equation.attenuation import dial
from clod_adapter.render import render, splat
from scenes import camera, dialled, gaussians

FAINTEST = {"tau": 1 / 255, "cut": "hard"}  # what this drops, the rasterizer skips
CONFIG = AttenuationConfig(**FAINTEST, scene_distance=3.0)


@pytest.mark.filterwarnings("ignore:virtual_scale")
def test_a_disabled_adapter_is_the_base() -> None:
    """Bit for bit: without a dial at any s, and with a dial without decay at s = 1."""
    base, view = gaussians(300, 1, 0), camera()
    want = render(base, view)
    assert want.image.abs().sum() > 0 and want.kept.all()
    for found in (
        render(detach(with_dial(base, torch.ones(300), CONFIG)), view, 3.0),
        *(render(base, view, s) for s in (1.0, 2.0, 7.0)),
    ):
        assert all(torch.equal(getattr(found, name), getattr(want, name)) for name in ("image", "alpha", "kept"))
    for config in (None, CONFIG, AttenuationConfig(**FAINTEST, normalizer="max")):
        identity = render(with_dial(base, attenuation=config), view)
        assert torch.equal(identity.image, want.image) and torch.equal(identity.alpha, want.alpha)
        assert torch.equal(identity.kept, base.opacities > 1 / 255)


def test_bad_arguments_are_refused() -> None:
    base = gaussians(5, 0, 0)
    for value in (-1e-3, math.inf, math.nan):
        with pytest.raises(ClodError, match="virtual_scale"):
            render(base, camera(), value)
    with pytest.raises(ClodError, match="background"):  # a kernel would read past its end
        render(base, camera(), background=torch.ones(1))
    with pytest.raises(ClodError, match="opacities"):
        splat(base, base.opacities[:3], camera())


@pytest.mark.filterwarnings("ignore:virtual_scale")
def test_rendering_no_gaussians() -> None:
    none = gaussians(0, 1, 0)
    for some in (none, with_dial(none), with_dial(none, attenuation=AttenuationConfig(normalizer="max"))):
        rendering = render(some, camera(), 2.0)
        assert rendering.kept.shape == (0,) and (rendering.image == 0).all() and (rendering.alpha == 0).all()


@pytest.mark.parametrize("cut", ["soft", "hard"])
def test_a_dial_of_0_shows_the_file_without_its_dial(cut: str) -> None:
    own, view = dialled(400, 1, 3, cut=cut).replace(growth_d=torch.linspace(0, 1, 400)), camera()
    assert torch.equal(render(own, view, 0.0).image, render(detach(own), view).image)
    shown = dial(own, view, 0.0)
    assert bool(shown.keep.all()) and torch.equal(shown.drawn, own.opacities) and bool((shown.growth == 1).all())
    faded = [dial(own, view, s) for s in (0.0, 1e-4, 0.3, 0.6, 1 - 1e-4, 1.0, 2.0)]
    for nearer, farther in zip(faded, faded[1:], strict=False):
        assert bool((farther.opacities <= nearer.opacities).all()) and bool((farther.keep <= nearer.keep).all())
