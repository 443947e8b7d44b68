"""Rendering with and without a dial, baking; calls that would draw or store something else."""

import math
import re
import warnings
from dataclasses import replace
from functools import partial

import pytest
import torch
from refusals import refused
from torch.testing import assert_close

import gsplat_versions
import inria_forks
from backends import fresh_copy, gsplat_arguments
from clod_adapter import AttenuationConfig, Hook, bake, render, save
from clod_adapter.adapter import detach, with_dial
from clod_adapter.config import FORMS
from clod_adapter.equation.attenuation import attenuate, dial
from clod_adapter.equation.distances import normalized_distances, viewpoint_of
from clod_adapter.rasterizers import Rasterizer, reference
from clod_adapter.render import splat
from scenes import attenuated, camera, gaussians, ring, seeded

CONFIG = AttenuationConfig(scene_distance=3.0)


@pytest.mark.filterwarnings("ignore:virtual_scale")
def test_a_disabled_adapter_is_the_base():
    """Bit for bit: without a dial at any s, and with a dial without decay at s = 1."""
    base = gaussians(300, 1, 0)
    view = camera()
    want = render(base, view)
    assert want.image.abs().sum() > 0 and want.kept.all()
    for rendering in (
        render(detach(with_dial(base, torch.ones(300), CONFIG)), view, 3.0),
        *(render(with_dial(base, attenuation=config), view) for config in (None, CONFIG)),
        *(render(base, view, s) for s in (1.0, 2.0, 7.0)),
    ):
        for name in ("image", "alpha", "kept"):
            assert torch.equal(getattr(rendering, name), getattr(want, name))


@pytest.mark.filterwarnings("ignore:virtual_scale")
def test_rendering_no_gaussians():
    none = gaussians(0, 1, 0)
    of_paper = with_dial(none, attenuation=AttenuationConfig(form="paper"))
    for model in (none, with_dial(none), of_paper):
        rendering = render(model, camera(), 2.0)
        assert rendering.kept.shape == (0,)
        assert not rendering.image.any() and not rendering.alpha.any()


@pytest.mark.parametrize("form", FORMS)
def test_a_dial_of_0_shows_the_file_without_its_dial(form):
    own = attenuated(400, 1, 3, form=form).replace(growth_d=torch.linspace(0, 1, 400))
    view = camera()
    found = render(own, view, 0.0).image
    want = render(detach(own), view).image
    assert_close(found, want, rtol=0, atol=0 if form == "ours" else 1e-6)
    shown = dial(own, view, 0.0)
    assert bool(shown.keep.all())
    assert torch.equal(shown.drawn, own.opacities)
    assert bool((shown.growth == 1).all())
    faded = [dial(own, view, s) for s in (0.0, 1e-4, 0.3, 0.6, 1 - 1e-4, 1.0, 2.0)]
    for nearer, farther in zip(faded, faded[1:], strict=False):
        assert bool((farther.drawn <= nearer.drawn).all())
        assert bool((farther.keep <= nearer.keep).all())


WORLD = AttenuationConfig(scene_distance=4.0)


def test_a_dial_without_effect_changes_nothing():
    model = gaussians(50, 0, 1)
    # more than opaque is left, no number is not
    model.opacity_logits[:2] = torch.tensor([22.0, math.inf])
    baked = bake(with_dial(model), 1.0, cameras=[camera(), camera()])
    assert baked.opacity_logits[:2].tolist() == [22, 20]
    assert torch.equal(baked.opacity_logits[2:], model.opacity_logits[2:])


def spread(**settings):
    """Gaussians at many distances from ``camera()``, some of which are culled, and most of which
    grow.
    """
    sigma, growth = torch.rand(2, 300, generator=seeded(2))
    model = with_dial(gaussians(300, 1, 7), 5 * sigma + 0.1, replace(WORLD, **settings))
    model.opacity_logits[:30:10] = math.inf
    return model.replace(growth_d=1.5 * growth - 0.25)


@pytest.mark.parametrize("form", FORMS)
def test_baked_image_matches_render_from_its_camera(form):
    model = spread(form=form)
    want = render(model, camera(), 2.5)
    baked = bake(model, 2.5, camera())
    assert baked.sigma_d is baked.growth_d is baked.attenuation is None
    assert baked.opacity_logits.isfinite().all()
    assert len(baked) == want.kept.sum() and 0 < len(baked) < 300
    assert_close(render(baked, camera()).image, want.image, atol=2e-5, rtol=0)


def test_several_cameras_share_one_distance_per_gaussian():
    model = spread()
    cameras = ring(3, 61, 45)
    s = 3.0
    logs = [normalized_distances(model.means, camera, WORLD).log() for camera in cameras]
    d = torch.stack(logs).mean(0).exp()

    def at(s):
        given = (model.opacity_logits, model.sigma_d, d, s, model.attenuation)
        return attenuate(*given, growth_d=model.growth_d)

    keep = at(s).keep
    baked = bake(model, s, cameras=cameras)
    assert torch.equal(baked.means, model.means[keep]) and 0 < len(baked) < 300
    assert_close(baked.opacities, at(s**0.75).drawn[keep], atol=1e-6, rtol=1e-5)
    scales = model.scales * at(s**0.9).growth[:, None]
    assert_close(baked.scales, scales[keep], atol=1e-6, rtol=1e-5)
    places = [viewpoint_of(camera, model.means, WORLD) for camera in cameras]
    assert torch.equal(bake(model, s, cameras=places).means, baked.means)


def test_beyond_the_trained_range_the_smallest_file_is_merged():
    model = spread(max_sv=2.0)
    smallest = bake(model, 2.0, cameras=[camera()])
    count = int(render(model, camera(), virtual_scale=6.0).kept.sum())
    merged = bake(model, 6.0, cameras=[camera()])
    assert len(merged) == count and 0 < count < len(smallest) / 2
    want = render(smallest, camera()).image

    def error(gaussians):
        return float((render(gaussians, camera()).image - want).square().mean())

    assert error(merged) < error(smallest[:count]) / 2


@pytest.mark.parametrize("form", FORMS)
def test_autocast_changes_nothing(form):
    model = spread(form=form)
    view = camera()
    for rasterizer in (None, Rasterizer(reference.rasterize)):
        want = render(model, view, 2.0, rasterizer=rasterizer)
        with torch.autocast("cpu"):
            found = render(model, view, 2.0, rasterizer=rasterizer)
        assert torch.equal(found.image, want.image) and torch.equal(found.kept, want.kept)


NO_DIALS = (-0.001, math.inf, math.nan, "5", None, [1.0], torch.ones(2), 10**400)


def test_bad_arguments_are_refused():
    model = spread()
    plain = gaussians(3, 0, 0)
    wrong = "a.ply"
    for message, call in {
        **{
            f"virtual_scale is {re.escape(str(s))}": partial(render, plain, camera(), s)
            for s in NO_DIALS
        },
        **{f"scale is {re.escape(str(s))}": partial(render, model, camera(), s) for s in NO_DIALS},
        "gaussians is a str, it must be of type Gaussians": lambda: render(wrong, camera()),
        "camera is a str, it must be of type Camera": lambda: render(plain, wrong),
        "background is 'a.ply', it must be an array of numbers": lambda: render(
            plain, camera(), background=wrong
        ),
        # a kernel would read past its end
        "background": lambda: render(plain, camera(), background=torch.ones(1)),
        "opacities": lambda: splat(plain, plain.opacities[:2], camera()),
        "no sigma_d": lambda: bake(plain, 1.0),
        "virtual_scale is -0.5": lambda: bake(model, -0.5, camera()),
        "no Gaussian is kept at s = 200": lambda: bake(model, 200.0, camera()),
        "either camera or cameras": lambda: bake(model, 2.0),
    }.items():
        with refused(message):
            call()


N = 20
VIEW = camera(24, 18)
DEFAULTS = AttenuationConfig()
MODEL = with_dial(gaussians(N, 1, 0), torch.ones(N), DEFAULTS, torch.ones(N))
HOOK = Hook(MODEL.sigma_d, DEFAULTS, 2.0, MODEL.growth_d)
WHOLE = torch.ones(N, dtype=torch.int64)


@pytest.fixture
def draws(monkeypatch):
    """The drop-ins for gsplat and for Inria's rasterizer, and the renderer, called with arguments
    of the dial alone.
    """
    gsplat = fresh_copy(monkeypatch, "gsplat", "gsplat", gsplat_versions.module("1.5.3"))
    fork = inria_forks.module("inria")
    inria = fresh_copy(monkeypatch, "inria", "diff_gaussian_rasterization", fork)
    of_inria = inria.GaussianRasterizer(
        inria_forks.settings_of(fork.GaussianRasterizationSettings, VIEW)
    )
    plain = gaussians(N, 1, 0)
    return {
        "gsplat": lambda **dial: gsplat.rasterization(**gsplat_arguments(plain, VIEW) | dial),
        "inria": lambda **dial: of_inria(**inria_forks.arguments_of(plain) | dial),
        "render": lambda **dial: render(plain, VIEW, **dial),
    }


@pytest.mark.parametrize("name", ["gsplat", "inria", "render"])
def test_a_dial_value_without_a_dial_is_warned_of(draws, name):
    message = "virtual_scale is 3, but there is no sigma_d: all .* drawn as they are"
    with pytest.warns(UserWarning, match=message) as told:
        draws[name](virtual_scale=3)
    assert name == "inria" or told[0].filename == __file__  # torch calls Inria's
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draws[name]()


GROWTH = "growth_d needs sigma_d and attenuation"


@pytest.mark.parametrize("name", ["gsplat", "inria"])
@pytest.mark.parametrize(
    "given, message",
    [
        ({"growth_d": MODEL.growth_d, "sigma_d": MODEL.sigma_d}, GROWTH),
        ({"growth_d": MODEL.growth_d, "attenuation": DEFAULTS}, GROWTH),
        ({"virtual_scale": -1}, "virtual_scale is -1, it must be a finite number of at least 0"),
        (
            {"sigma_d": MODEL.sigma_d, "opacities": WHOLE},
            "opacities is torch.int64, it must be floating point",
        ),
        ({"sigma_d": WHOLE}, "sigma_d is torch.int64, it must be floating point"),
    ],
)
def test_drop_ins_refuse(draws, name, given, message):
    with refused(message):
        draws[name](**given)


@pytest.mark.parametrize(
    "call, message",
    [
        (
            lambda: MODEL.replace(means=MODEL.means.long()),
            "Gaussians.means is torch.int64, it must",
        ),
        (lambda: MODEL.replace(opacity_logits=WHOLE), "Gaussians.opacity_logits is torch.int64"),
        (lambda: HOOK(MODEL.means, WHOLE, VIEW.viewmat), "opacities is torch.int64"),
        (
            lambda: HOOK(MODEL.means.long().numpy(), MODEL.opacities.numpy(), VIEW.viewmat),
            "means is torch.int64",
        ),
    ],
)
def test_calls_are_refused(call, message):
    with refused(message):
        call()


@pytest.mark.parametrize(
    "name, message",
    [
        ("x.foo", ".foo is no format to write; choose one of .ply, .spz, "),
        ("x", "no suffix is no format"),
        ("x.ksplat", ".ksplat is no format"),
        ("x.sog", "is written by clod-adapt export alone: save a .ply"),
        ("x.glb", "is written by clod-adapt export alone: save a .ply"),
    ],
)
def test_files_that_save_does_not_write(name, message, tmp_path):
    with refused(f"{name}: {message}"):
        save(tmp_path / name, MODEL)
    assert not list(tmp_path.iterdir())
