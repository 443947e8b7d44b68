"""The browser's picture equals ``clod_adapter.render`` at the same camera and dial value."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import scenes
from clod_adapter.cameras import Camera
from clod_adapter.config import FILTERS, ScreenFilter
from clod_adapter.render import render
from clod_adapter.viewer.payload import Payload
from shown import Shown, assert_alike, assert_same, take


@pytest.mark.parametrize("degree", [0, 3])
def test_at_dial_values_and_without_the_equation(shown: Shown, save: Any, artefacts: Path, degree: int) -> None:
    gaussians, camera = scenes.dialled(1500, degree, 7), scenes.camera(320, 240)
    take(shown, save(gaussians))
    shown.camera(camera)
    for s in (1.0, 3.0):
        shown.run("clod.setDial(given)", s)
        assert_same(shown, render(gaussians, camera, s), artefacts / f"degree{degree}_s{s:g}.png")
    shown.run("clod.setEquation(false)")
    plain = gaussians.replace(sigma_d=None, attenuation=None)
    assert_same(shown, render(plain, camera), artefacts / f"degree{degree}_off.png")


@pytest.mark.parametrize(
    ("settings", "screen_filter"),
    [
        ({"cut": "hard", "normalizer": "max"}, FILTERS["on"]),
        ({"tau": 1 / 255, "normalizer": "quantile", "quantile": 0.7}, FILTERS["mip"]),
        ({"tau": 0.05, "eps": 0.5, "scene_distance": 2.0}, ScreenFilter(variance=2.0)),
    ],
    ids=["hard, on", "quantile, mip", "eps, blur"],
)
def test_settings_and_screen_filters(
    show: Any, save: Any, artefacts: Path, settings: dict[str, Any], screen_filter: ScreenFilter
) -> None:
    """With Gaussians of at most a pixel, for which filters differ: the classic filter gives a different picture."""
    classic = scenes.dialled(1500, 1, 7, **settings)
    classic = classic.replace(log_scales=classic.log_scales - 2.0)
    gaussians, camera = classic.replace(screen_filter=screen_filter), scenes.camera(320, 240)
    shown = show(save(gaussians), "--sv", 2)
    shown.camera(camera)
    wanted = render(gaussians, camera, 2.0)
    assert 0.05 < wanted.kept.float().mean() < 0.95
    assert_same(shown, wanted, artefacts / f"filter_{screen_filter.variance}.png")
    with pytest.raises(AssertionError):
        assert_alike(shown.picture(), render(classic, camera, 2.0).pixels.numpy(), artefacts / "classic.png")


@pytest.mark.parametrize(
    ("degree", "settings"), [(0, {}), (3, {"normalizer": "quantile", "quantile": 0.3})], ids=["scene", "quantile"]
)
def test_growth(shown: Shown, artefacts: Path, tmp_path: Path, degree: int, settings: dict[str, Any]) -> None:
    """Exponents of both signs. Some Gaussians have their centre outside the picture and grow into it."""
    plain = scenes.dialled(1500, degree, 7, max_sv=10.0, reference_distance=4.5, **settings)
    camera = scenes.camera(320, 240, fov=40)
    plain = plain.replace(log_scales=plain.log_scales - 1.0)
    model = plain.replace(growth_d=torch.linspace(-1, 1.5, 1500))
    (tmp_path / "grown.ply").write_bytes(b"".join(Payload("grown.ply", model).blocks()))
    take(shown, tmp_path / "grown.ply")
    shown.camera(camera)
    for s in (1.0, 3.0, 8.0):
        shown.run("clod.setDial(given)", s)
        assert_same(shown, render(model, camera, s), artefacts / f"growth{degree}_s{s:g}.png")
        with pytest.raises(AssertionError):
            assert_same(shown, render(plain, camera, s), artefacts / "not_grown.png")
    shown.run("clod.setEquation(false)")
    assert_same(shown, render(plain.replace(sigma_d=None, attenuation=None), camera), artefacts / "growth_off.png")


def test_gaussians_that_grow_far_beyond_the_picture(shown: Shown, artefacts: Path, tmp_path: Path) -> None:
    """By factors up to 1e8. Quads of that size would be drawn inexactly; they end at the picture's farthest corner."""
    model = scenes.dialled(1500, 0, 7, max_sv=40.0, reference_distance=2.0)
    model, camera = model.replace(growth_d=torch.linspace(-1, 5, 1500)), scenes.camera(320, 240)
    (tmp_path / "grown.ply").write_bytes(b"".join(Payload("grown.ply", model).blocks()))
    take(shown, tmp_path / "grown.ply")
    shown.camera(camera)
    shown.run("clod.setDial(given)", 20.0)
    assert_same(shown, render(model, camera, 20.0), artefacts / "far_beyond.png")


def test_through_cameras_of_other_shapes(shown: Shown, save: Any, artefacts: Path) -> None:
    """Portrait format, the principal point in a corner, and a small unit of length with a nearer near plane."""
    gaussians = scenes.dialled(1500, 0, 7)
    take(shown, save(gaussians))
    for k, camera in enumerate([scenes.camera(180, 240, fov=100), scenes.camera(320, 240, off_centre=(0.1, 0.9))]):
        shown.camera(camera)
        assert_same(shown, render(gaussians, camera), artefacts / f"shape{k}.png")
    size = 1e-3
    small = gaussians.replace(
        means=size * gaussians.means, log_scales=gaussians.log_scales + float(np.log(size)),
        attenuation=replace(gaussians.attenuation, scene_distance=3 * size),
    )  # fmt: skip
    viewmat = scenes.camera().viewmat.clone()
    viewmat[:3, 3] *= size
    near = Camera(viewmat, scenes.camera(320, 240).K, 320, 240, near=0.01 * size)
    take(shown, save(small, "small.ply"))
    shown.camera(near)
    assert_same(shown, render(small, near), artefacts / "small.png")


def test_wipe_shows_both_sides(show: Any, save: Any, artefacts: Path) -> None:
    gaussians, camera = scenes.dialled(1500, 0, 7), scenes.camera(320, 240)
    plain = gaussians.replace(sigma_d=None, attenuation=None, sh0=-gaussians.sh0)
    shown = show(save(gaussians), "--base", save(plain, "base.ply"), "--sv", 3)
    shown.camera(camera)
    sides = {"base": render(plain, camera), 1.5: render(gaussians, camera, 1.5)}
    for other, right in sides.items():
        shown.run("clod.setWipe(0.4, given)", other)
        left = render(gaussians, camera, 3.0).pixels.numpy()
        both = np.concatenate([left[:, :128], right.pixels.numpy()[:, 128:]], axis=1)
        assert_alike(shown.picture(), both, artefacts / f"wipe_{other}.png")
    shown.run("clod.setWipe(null)")
    assert_same(shown, render(gaussians, camera, 3.0), artefacts / "wipe_off.png")
