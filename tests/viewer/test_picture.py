"""The picture in the browser is ours: ``clod_adapter.render`` at the same camera and dial."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import scenes
from clod_adapter.cameras import Camera
from clod_adapter.config import FILTERS, AttenuationConfig, ScreenFilter
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import write
from clod_adapter.render import Rendering, render
from shown import drop

WITHIN = 45.0  # dB
COUNTS = 1e-3  # of the count
SOFT = AttenuationConfig(tau=0.02, cut="soft", scene_distance=3.0)


def dialled(degree: int, attenuation: AttenuationConfig = SOFT, n: int = 3000) -> Gaussians:
    """Long and flat Gaussians before and behind each other, whose sigma_d reach from gone to never fading."""
    plain = scenes.gaussians(n, degree, 7)
    generator = torch.Generator().manual_seed(8)
    sigma_d = (torch.randn(n, generator=generator) + 1).exp()
    sigma_d[::50] = 0.0
    return plain.replace(sigma_d=sigma_d, attenuation=attenuation)


def assert_alike(picture: np.ndarray, wanted: np.ndarray, keep: Path) -> None:
    Image.fromarray(np.concatenate([picture, wanted], axis=1)).save(keep)
    error = float(((picture.astype(np.float64) - wanted) ** 2).mean())
    assert 10 * np.log10(255**2 / max(error, 1e-9)) >= WITHIN, keep.name


def assert_same(shown: Any, wanted: Rendering, keep: Path) -> None:
    counts = shown.counts()
    assert_alike(shown.picture(), wanted.pixels.numpy(), keep)
    kept = int(wanted.kept.sum())
    assert abs(counts["kept"] - kept) <= COUNTS * kept and counts["total"] == len(wanted.kept)


@pytest.mark.parametrize("degree", [0, 3])
def test_at_dial_values_and_without_the_equation(show: Any, files: Any, artefacts: Path, degree: int) -> None:
    gaussians, camera = dialled(degree), scenes.camera(320, 240)
    shown = show(files.save(gaussians))
    shown.camera(camera)
    for s in (1.0, 3.0):
        shown.run("clod.setDial(given)", s)
        assert_same(shown, render(gaussians, camera, s), artefacts / f"degree{degree}_s{s:g}.png")
    shown.run("clod.setEquation(false)")
    plain = gaussians.replace(sigma_d=None, attenuation=None)
    assert_same(shown, render(plain, camera), artefacts / f"degree{degree}_off.png")


@pytest.mark.parametrize(
    "attenuation",
    [
        AttenuationConfig(tau=0.02, cut="hard", normalizer="max"),
        AttenuationConfig(tau=1 / 255, cut="soft", normalizer="quantile", quantile=0.7),
        AttenuationConfig(tau=0.05, cut="soft", eps=0.5, scene_distance=2.0),
    ],
    ids=["paper", "quantile", "eps"],
)
def test_with_other_settings(show: Any, files: Any, artefacts: Path, attenuation: AttenuationConfig) -> None:
    gaussians, camera = dialled(1, attenuation), scenes.camera(320, 240)
    shown = show(files.save(gaussians), "--sv", 2)
    shown.camera(camera)
    wanted = render(gaussians, camera, 2.0)
    assert 0.05 < wanted.kept.float().mean() < 0.95
    assert_same(shown, wanted, artefacts / f"{attenuation.cut}_{attenuation.normalizer}_{attenuation.eps:g}.png")


@pytest.mark.parametrize("screen_filter", [FILTERS["on"], FILTERS["mip"], ScreenFilter(variance=2.0)], ids=str)
def test_with_the_filter_of_the_file(show: Any, files: Any, artefacts: Path, screen_filter: ScreenFilter) -> None:
    """Of a pixel and less, where filters differ: the usual one is another picture."""
    dial = dialled(0)
    gaussians = dial.replace(log_scales=dial.log_scales - 2.0, screen_filter=screen_filter)
    camera, usual = scenes.camera(320, 240), dial.replace(log_scales=dial.log_scales - 2.0)
    shown = show(files.save(gaussians), "--base", files.save(usual, "usual.ply"))
    shown.camera(camera)
    for s in (1.0, 3.0):
        shown.run("clod.setDial(given)", s)
        assert_same(shown, render(gaussians, camera, s), artefacts / f"filter_{screen_filter.variance}_s{s:g}.png")
    with pytest.raises(AssertionError):
        assert_alike(shown.picture(), render(usual, camera, 3.0).pixels.numpy(), artefacts / "not_that.png")


@pytest.mark.parametrize("form", ["comments", "columns", "spz", "tag"])
def test_a_dropped_file_is_drawn_with_its_filter(show: Any, files: Any, artefacts: Path, form: str) -> None:
    """Said by our comments, by columns where those are gone, in an SPZ, and by another program's comment."""
    dial = dialled(0)
    name = "on" if form == "tag" else "mip"
    gaussians = dial.replace(log_scales=dial.log_scales - 2.0, screen_filter=FILTERS[name])
    gaussians = gaussians.replace(sigma_d=None, attenuation=None) if form == "tag" else gaussians
    path = files.folder / ("a.spz" if form == "spz" else "a.ply")
    write(path, gaussians)
    if form in ("columns", "tag"):
        gone = rb"(?m)^comment .*\n" if form == "columns" else rb"(?m)^comment clod_adapter .*\n"
        path.write_bytes(re.sub(gone, b"", path.read_bytes()))
    camera, found = scenes.camera(320, 240), load(path).gaussians
    assert found.screen_filter == FILTERS[name]
    shown = show(files.save(dial, "other.ply"))
    drop(shown, path.name, path.read_bytes())
    shown.until(f"document.title === '{path.name}'")
    shown.camera(camera)
    assert_same(shown, render(found, camera), artefacts / f"dropped_{form}.png")


def test_through_cameras_of_other_shapes(show: Any, files: Any, artefacts: Path) -> None:
    """Upright, with the principal point in a corner, and in a unit so small that its near plane is nearer."""
    gaussians = dialled(0)
    shown = show(files.save(gaussians))
    for k, camera in enumerate([scenes.camera(180, 240, fov=100), scenes.camera(320, 240, off_centre=(0.1, 0.9))]):
        shown.camera(camera)
        assert_same(shown, render(gaussians, camera), artefacts / f"shape{k}.png")
    size = 1e-3
    small = gaussians.replace(
        means=size * gaussians.means, log_scales=gaussians.log_scales + float(np.log(size)),
        attenuation=replace(SOFT, scene_distance=3 * size),
    )  # fmt: skip
    viewmat = scenes.camera().viewmat.clone()
    viewmat[:3, 3] *= size
    near = Camera(viewmat, scenes.camera(320, 240).K, 320, 240, near=0.01 * size)
    shown = show(files.save(small, "small.ply"))
    shown.camera(near)
    assert_same(shown, render(small, near), artefacts / "small.png")


def test_wipe_shows_both_sides(show: Any, files: Any, artefacts: Path) -> None:
    gaussians, camera = dialled(0), scenes.camera(320, 240)
    plain = gaussians.replace(sigma_d=None, attenuation=None, sh0=-gaussians.sh0)
    shown = show(files.save(gaussians), "--base", files.save(plain, "base.ply"), "--sv", 3)
    shown.camera(camera)
    sides = {"base": render(plain, camera), 1.5: render(gaussians, camera, 1.5)}
    for other, right in sides.items():
        shown.run("clod.setWipe(0.4, given)", other)
        left = render(gaussians, camera, 3.0).pixels.numpy()
        both = np.concatenate([left[:, :128], right.pixels.numpy()[:, 128:]], axis=1)
        assert_alike(shown.picture(), both, artefacts / f"wipe_{other}.png")
    shown.run("clod.setWipe(null)")
    assert_same(shown, render(gaussians, camera, 3.0), artefacts / "wipe_off.png")
