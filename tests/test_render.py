"""Rendering with and without a dial; baking for one camera and for several, and the order of rows by extinction."""

import math
from dataclasses import replace

import pytest
import torch

from clod_adapter import AttenuationConfig, ClodError, Gaussians, bake, detach, order_by_extinction, render, with_dial
from clod_adapter.equation.attenuation import attenuate, dial
from clod_adapter.equation.distances import normalized_distances, viewpoint_of
from clod_adapter.render import splat
from scenes import camera, dialled, gaussians, ring

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


WORLD = AttenuationConfig(scene_distance=4.0)


def test_a_dial_without_effect_changes_nothing() -> None:
    some = gaussians(50, 0, 1)
    some.opacity_logits[:2] = torch.tensor([22.0, math.inf])  # more than opaque is left, no number is not
    baked = bake(with_dial(some), 1.0, cameras=[camera(), camera()])
    want = some.opacity_logits[some.opacities > 1 / 255]
    assert (float(baked.opacity_logits[1]), float(want[1])) == (20.0, math.inf)
    assert torch.equal(baked.opacity_logits[2:], want[2:]) and baked.opacity_logits[0] == 22


def spread(**settings: str) -> Gaussians:
    """Gaussians at many distances from ``camera()``, some of which are culled, and most of which grow."""
    sigma, growth = torch.rand(2, 300, generator=torch.Generator().manual_seed(2))
    some = with_dial(gaussians(300, 1, 7), 2 * sigma + 0.1, replace(WORLD, **settings))
    some.opacity_logits[:30:10] = math.inf
    return some.replace(growth_d=1.5 * growth - 0.25)


def test_baked_image_matches_render_from_its_camera() -> None:
    some = spread(normalizer="max", cut="hard")
    want, baked = render(some, camera(), 2.5), bake(some, 2.5, camera())
    assert baked.sigma_d is baked.growth_d is baked.attenuation is None and baked.opacity_logits.isfinite().all()
    assert len(baked) == want.kept.sum() and 0 < len(baked) < 300
    torch.testing.assert_close(render(baked, camera()).image, want.image, atol=2e-5, rtol=0)


def test_several_cameras_share_one_distance_per_gaussian() -> None:
    some, cameras, s = spread(), ring(3, 61, 45), 3.0
    assert some.sigma_d is not None and some.attenuation is not None
    d = torch.stack([normalized_distances(some.means, each, WORLD).log() for each in cameras]).mean(0).exp()
    given = (some.opacity_logits, some.sigma_d, d)
    kept, shown, grown = (attenuate(*given, x, some.attenuation, growth_d=some.growth_d) for x in (s, s**0.75, s**0.9))
    baked = bake(some, s, cameras=cameras)
    assert torch.equal(baked.means, some.means[kept.keep]) and 0 < len(baked) < 300
    torch.testing.assert_close(baked.opacities, shown.drawn[kept.keep], atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(baked.scales, (some.scales * grown.growth[:, None])[kept.keep], atol=1e-6, rtol=1e-5)
    places = [viewpoint_of(each, some.means, WORLD) for each in cameras]
    assert torch.equal(bake(some, s, cameras=places).means, baked.means)


def test_bad_arguments_are_refused() -> None:
    some, plain = spread(), gaussians(3, 0, 0)
    for message, call in {
        **{f"virtual_scale is {s}": lambda s=s: render(plain, camera(), s) for s in (-0.001, math.inf, math.nan)},
        "background": lambda: render(plain, camera(), background=torch.ones(1)),  # a kernel would read past its end
        "opacities": lambda: splat(plain, plain.opacities[:2], camera()),
        "no sigma_d": lambda: bake(plain, 1.0),
        "virtual_scale is -0.5": lambda: bake(some, -0.5, camera()),
        "no Gaussian is kept at s = 200": lambda: bake(some, 200.0, camera()),
        "either camera or cameras": lambda: bake(some, 2.0),
        "no camera is given": lambda: order_by_extinction(some, []),
        "no pruning order": lambda: order_by_extinction(plain, [camera()]),
    }.items():
        with pytest.raises(ClodError, match=message):
            call()
