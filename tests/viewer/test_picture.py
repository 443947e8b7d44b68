"""The browser's picture equals ``clod_adapter.render`` at the same camera and dial value."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import scenes
from clod_adapter.cameras import Camera
from clod_adapter.config import FILTERS, ScreenFilter
from clod_adapter.gaussians import Gaussians
from clod_adapter.render import render
from shown import TALL, Shown, assert_alike, assert_same, take

VIEW, WIDE = scenes.camera(320, 240), ScreenFilter(variance=2.0)


def finer(model: Gaussians, by: float, **changes: Any) -> Gaussians:
    return model.replace(log_scales=model.log_scales - by, **changes)


def grown(count: int, degree: int, power: float, by: float, **settings: Any) -> Gaussians:
    """With growth of both signs; some Gaussians have their centre outside the picture and grow into it."""
    model = scenes.dialled(count, degree, 7, **settings)
    return finer(model, by, growth_d=torch.linspace(-1, power, count))


def small(size: float) -> tuple[Gaussians, tuple[float, ...], Camera]:
    """In another unit of length, with a nearer near plane."""
    model = scenes.dialled(500, 0, 7, scene_distance=3 * size)
    viewmat = VIEW.viewmat.clone()
    viewmat[:3, 3] *= size
    model = finer(model, -float(np.log(size)), means=size * model.means)
    return model, (1.0,), replace(VIEW, viewmat=viewmat, near=0.01 * size)


# Model, dial values and camera; each differs from the others in what is named.
CASES: dict[str, tuple[Gaussians, tuple[float, ...], Camera]] = {
    "degree 3": (scenes.dialled(500, 3, 7), (1.0, 3.0), VIEW),
    "hard, view's unit, compensated": (
        finer(scenes.dialled(500, 1, 7, cut="hard", normalizer="max"), 2, screen_filter=FILTERS["on"]), (2.0,), VIEW
    ),
    "eps, wide blur": (
        finer(scenes.dialled(500, 1, 7, tau=0.05, eps=0.5, scene_distance=2.0), 2, screen_filter=WIDE),
        (2.0,), VIEW,
    ),
    "growth": (
        grown(1500, 0, 1.5, 1, max_sv=10.0, reference_distance=4.5), (1.0, 8.0), scenes.camera(320, 240, fov=40)
    ),
    # By factors up to 1e8: quads of that size would be drawn inexactly; they end at the picture's farthest corner.
    "far beyond the picture": (grown(300, 0, 5, 0, max_sv=40.0, reference_distance=2.0), (20.0,), VIEW),
    "millimetres": small(1e-3),
    "off centre": (scenes.dialled(500, 0, 7), (1.0,), scenes.camera(180, 240, fov=100, off_centre=(0.1, 0.9))),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_picture_and_the_count(shown: Shown, save: Any, name: str) -> None:
    model, dials, camera = CASES[name]
    take(shown, save(model))
    shown.camera(camera)
    for s in dials:
        shown.run("clod.setDial(given)", s)
        assert_same(shown, render(model, camera, s))
        if name in ("growth", "eps, wide blur"):  # the measure tells them from models without it
            other = model.replace(growth_d=None, screen_filter=FILTERS["off"])
            with pytest.raises(AssertionError):
                assert_alike(shown.picture(), render(other, camera, s).pixels.numpy())
    shown.run("clod.setEquation(false)")
    bare = model.replace(sigma_d=None, growth_d=None, attenuation=None)
    assert_same(shown, render(bare, camera))


def test_wipe_shows_both_sides(show: Any, save: Any) -> None:
    """The base, or the same file without its dial, which is then on at the left; by a switch, and by C."""
    gaussians = scenes.dialled(600, 0, 7)
    base = gaussians.replace(sigma_d=None, attenuation=None, sh0=-gaussians.sh0)
    shown = show(save(gaussians), "--base", save(base, "base.ply"), "--sv", 3, viewport=TALL)
    left = render(gaussians, VIEW, 3.0).pixels.numpy()
    for right in (base, base.replace(sh0=gaussians.sh0)):
        shown.camera(VIEW)
        shown.page.check("#compare")
        shown.run("clod.setWipe(0.4)")
        both = np.concatenate([left[:, :128], render(right, VIEW).pixels.numpy()[:, 128:]], axis=1)
        assert_alike(shown.picture(), both)
        shown.page.keyboard.press("c")
        assert_same(shown, render(gaussians, VIEW, 3.0))
        take(shown, save(gaussians))
        shown.run("clod.setEquation(false)")
    shown.page.keyboard.press("c")
    assert shown.page.is_checked("#equation") and "dial off" in shown.text("#wipe-right")
    shown.page.focus("#wipe")
    shown.page.keyboard.press("Home")
    assert shown.page.input_value("#wipe") == "0"
