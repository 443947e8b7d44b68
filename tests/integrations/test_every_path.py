"""One adapted file looks the same through every path that draws it, and so do the files of
viewers/kit; the wrapper against stand-ins for Inria's rasterizer and a fork, called with the kept
rows alone.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from refusals import refused
from torch import Tensor

import clod_adapter as clod
import gsplat_in_torch
import inria_forks
import scenes
from backends import fresh_copy, gsplat_arguments
from clod_adapter.cameras import intrinsics
from clod_adapter.config import FILTERS
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.rasterizers import Rasterizer, reference
from clod_adapter.render import render
from inria_forks import FORKS, arguments_of, settings_of

DIAL = 3.0
VIEW = scenes.camera(48, 32, off_centre=(0.5, 0.5))  # Inria's settings have no principal point
KIT = Path(__file__).parents[2] / "viewers" / "kit"


def through_gsplat(checkpoint, monkeypatch):
    gsplat_in_torch.install(monkeypatch)
    from clod_adapter.integrations.gsplat import rasterization

    g = checkpoint.gaussians
    images, _, _ = rasterization(
        **gsplat_arguments(g, VIEW),
        sigma_d=g.sigma_d,
        growth_d=g.growth_d,
        attenuation=g.attenuation,
        virtual_scale=DIAL,
        eps2d=g.screen_filter.variance,
        rasterize_mode="antialiased" if g.screen_filter.compensate else "classic",
    )
    return images[0]


def inria(monkeypatch, installed):
    return fresh_copy(monkeypatch, "inria", "diff_gaussian_rasterization", installed)


def arguments(g, fork="inria"):
    """A fork's arguments by name, and those of the dial; floating-point tensors require
    gradients.
    """
    given = arguments_of(g) | {"sigma_d": g.sigma_d, "growth_d": g.growth_d}
    given = {
        name: value.clone().requires_grad_() for name, value in given.items() if value is not None
    }
    further = set(FORKS[fork][1].split()) - set(inria_forks.CALL.split())
    given |= {name: torch.ones(len(g), 2) for name in further}
    return given | {"attenuation": g.attenuation, "virtual_scale": DIAL}


def through_inria(checkpoint, monkeypatch):
    g = checkpoint.gaussians
    name, settings = (
        ("other", {"kernel_size": 0.1})
        if g.screen_filter == FILTERS["mip"]
        else ("inria", {"antialiasing": g.screen_filter.compensate})
    )
    ours = inria(monkeypatch, inria_forks.module(name))
    rasterizer = ours.GaussianRasterizer(
        settings_of(ours.GaussianRasterizationSettings, VIEW, **settings)
    )
    return rasterizer(**arguments(g))[0].permute(1, 2, 0).detach()


def through_hook(checkpoint, monkeypatch):
    """numpy, then a renderer that knows nothing of the dial."""
    g = checkpoint.gaussians
    arrays = (tensor.numpy() for tensor in (g.means, g.opacities, VIEW.viewmat))
    opacities, keep, growth = map(torch.from_numpy, checkpoint.hook(DIAL)(*arrays))
    assert torch.equal(opacities > 0, keep)
    plain = g.replace(
        sigma_d=None,
        growth_d=None,
        attenuation=None,
        log_scales=g.log_scales + growth.log()[:, None],
        opacity_logits=opacities.logit(),
    )
    return render(plain[keep], VIEW, rasterizer=Rasterizer(reference.rasterize)).image


def adapted(**settings):
    """60 Gaussians, of which a third is culled at the dial value, with growth of both signs."""
    some = scenes.attenuated(60, 1, 3, **settings)
    values = torch.rand(60, generator=scenes.seeded(5))
    return some.replace(
        means=some.means * torch.tensor([1, 1, 0.5]),
        sigma_d=2 * some.sigma_d,
        growth_d=2 * values - 0.5,
    )


def wanted(gaussians):
    return render(gaussians, VIEW, DIAL, rasterizer=Rasterizer(reference.rasterize)).image


@pytest.mark.filterwarnings("ignore:virtual_scale")
@pytest.mark.parametrize("screen_filter", FILTERS)
def test_paths_agree(screen_filter, tmp_path, monkeypatch):
    """With each screen filter. Without growth, the dial or the filter, the image is another."""
    model = adapted().replace(screen_filter=FILTERS[screen_filter])
    clod.save(tmp_path / "adapted.ply", model)
    checkpoint = clod.load(tmp_path / "adapted.ply")
    for draw in (through_gsplat, through_inria, through_hook):
        image = draw(checkpoint, monkeypatch)
        torch.testing.assert_close(image, wanted(model), rtol=1e-3, atol=1e-3)
    assert 20 < int(render(model, VIEW, DIAL).kept.sum()) < 50
    for other in (
        model.replace(growth_d=None),
        model.replace(sigma_d=None, growth_d=None, attenuation=None),
    ):
        assert (wanted(other) - wanted(model)).abs().max() > 0.1
    for name, other in FILTERS.items():
        assert (
            name == screen_filter
            or (wanted(model.replace(screen_filter=other)) - wanted(model)).abs().max() > 0.01
        )


@pytest.mark.parametrize(("suffix", "levels"), [("ply", 1), ("spz", 12)])
def test_the_kit_is_what_the_library_draws_and_writes(suffix, levels):
    gaussians = clod.load(KIT / f"kit.{suffix}").gaussians
    for about in json.loads((KIT / "cameras.json").read_text(encoding="utf-8"))["cameras"]:
        width, height, focal = about["width"], about["height"], about["focal"]
        K = intrinsics(focal, focal, width / 2, height / 2)
        camera = clod.Camera(torch.tensor(about["world_to_camera"]), K, width, height)
        for frame in about["frames"]:
            shown = clod.render(gaussians, camera, frame["s"])
            assert int(shown.kept.sum()) == pytest.approx(
                frame["kept"], rel=0.005 if suffix == "spz" else 0
            )
            stored = np.asarray(Image.open(KIT / frame["picture"], formats=["PNG"]), np.float64)
            assert np.abs(shown.image.clamp(0, 1).numpy() * 255 - stored).max() < levels


@pytest.mark.parametrize("name", FORKS)
def test_kept_rows_are_drawn_as_by_the_fork(name, monkeypatch):
    """Also called by position. Without sigma_d, results are the fork's."""
    fork, model = inria_forks.module(name), adapted(form="paper")
    given = arguments(model if name == "inria" else model.replace(growth_d=None), name)
    dial = {
        key: given.pop(key)
        for key in ("sigma_d", "growth_d", "attenuation", "virtual_scale")
        if key in given
    }
    settings = settings_of(
        fork.GaussianRasterizationSettings, VIEW, bg=torch.tensor([0.2, 0.5, 0.1])
    )
    theirs, module = fork.GaussianRasterizer(settings), inria(monkeypatch, fork)
    ours = module.GaussianRasterizer(raster_settings=settings)
    assert module.GaussianRasterizationSettings is fork.GaussianRasterizationSettings
    for mine, want in zip(ours(**given), theirs(**given), strict=True):
        assert torch.equal(mine, want)
    logits, where = given["opacities"][:, 0].logit(), (given["means3D"], VIEW)
    drawn = attenuate(
        logits, dial["sigma_d"], where, DIAL, dial["attenuation"], growth_d=dial.get("growth_d")
    )
    keep = drawn.keep
    assert 0 < int(keep.sum()) < 60
    rows = {key: value[keep] for key, value in given.items()} | {
        "opacities": drawn.drawn[keep, None]
    }
    want = theirs(**rows | {"scales": rows["scales"] * drawn.growth[keep, None]})
    got = ours(**given, **dial)
    assert torch.equal(ours(*map(given.get, FORKS[name][1].split()), **dial)[0], got[0])
    for result, mine, of_fork in zip(FORKS[name][2].split(), got, want, strict=True):
        if result in ("radii", "touched"):  # of all rows, 0 for culled ones
            assert torch.equal(mine[keep], of_fork) and len(mine) == 60 and not mine[~keep].any()
        elif result != "features":
            torch.testing.assert_close(mine, of_fork, rtol=1e-5, atol=1e-5)
    leaves = [
        each for each in (given | dial).values() if isinstance(each, Tensor) and each.requires_grad
    ]
    slopes = [torch.autograd.grad(picture[0].square().sum(), leaves) for picture in (got, want)]
    for leaf, mine, of_fork in zip(leaves, *slopes, strict=True):
        assert mine.shape == leaf.shape and not mine[~keep].any()
        torch.testing.assert_close(mine, of_fork, rtol=1e-3, atol=1e-4)
    assert float(slopes[0][-1].abs().max()) > 0


def test_culled_rows_are_invisible_to_a_fork_that_culls_at_zero(monkeypatch):
    """From many positions, since rounding moves a point at the camera's centre in front of it or
    behind it.
    """
    fork = inria_forks.module("inria", nearest=0.0)
    given, ours = (
        arguments(adapted().replace(sigma_d=torch.full((60,), 1e-3))),
        inria(monkeypatch, fork),
    )
    for view in scenes.ring(31, 48, 36):
        assert not ours.GaussianRasterizer(settings_of(fork.GaussianRasterizationSettings, view))(
            **given
        )[1].any()


def test_covariances_grow_by_the_square(monkeypatch):
    """``cov3D_precomp`` instead of scales and rotations, by name and by position."""
    fork, given = inria_forks.module("inria"), arguments(adapted())
    ours = inria(monkeypatch, fork).GaussianRasterizer(
        settings_of(fork.GaussianRasterizationSettings, VIEW)
    )
    ours(**given)
    growth = ours.given["scales"][:, 0] / given.pop("scales")[:, 0]
    assert growth.min() < 0.9 and growth.max() > 1.1
    given |= {
        "rotations": None,
        "cov3D_precomp": torch.rand(60, 6, generator=scenes.seeded(3)),
    }
    words = inria_forks.CALL.split()
    for values, names in (
        ([], given),
        (map(given.get, words), {k: v for k, v in given.items() if k not in words}),
    ):
        ours(*values, **names)
        torch.testing.assert_close(
            ours.given["cov3D_precomp"], given["cov3D_precomp"] * growth[:, None].square()
        )


def test_bad_arguments_are_refused(monkeypatch):
    fork, short = inria_forks.module("inria"), torch.ones(59)
    for prefiltered, changed, message in (
        (True, {}, "prefiltered is True.*set it to False"),
        (
            None,
            {"sigma_d": short, "growth_d": None},
            r"the dial is for 59 Gaussians, but means is \(60, 3\)",
        ),
        (None, {"growth_d": short}, r"sigma_d \(60,\), growth_d \(59,\)"),
    ):
        settings = settings_of(fork.GaussianRasterizationSettings, VIEW, prefiltered=prefiltered)
        with refused(message):
            inria(monkeypatch, fork).GaussianRasterizer(settings)(**arguments(adapted()) | changed)
    with pytest.raises(
        ImportError, match="pip install .*graphdeco-inria/diff-gaussian-rasterization"
    ):
        inria(monkeypatch, None)
