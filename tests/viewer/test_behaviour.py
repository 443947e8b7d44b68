"""The page in a browser: messages, file names, layout, and the self-contained page."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import clod_adapter
import scenes
from clod_adapter.calibration import Calibration, CalibrationRow
from clod_adapter.equation.attenuation import dial
from clod_adapter.gaussians import Gaussians
from clod_adapter.render import render
from clod_adapter.viewer import page, payload
from clod_adapter.viewer.page import write_viewer_page
from shown import COUNTS, SIZE, Shown, assert_same, serve, take


def test_a_file_without_sigma_d_has_no_dial(show: Any, save: Any, plain: Gaussians) -> None:
    """The page shows the reason, and the file's name as text."""
    name = "<img src=x onerror=clod=1><script>clod=1<!script>&amp;'\".ply"
    shown = show(save(plain, name))
    assert shown.text("#title") == name and shown.page.title() == name and shown.page.query_selector("img") is None
    assert shown.page.is_disabled("#dial") and shown.page.is_disabled("#target") and shown.page.is_disabled("#equation")
    reason = shown.text("#no-dial")
    assert f"{name} has no sigma_d" in reason and f"clod-adapt {name}" in reason
    assert shown.counts() == {"total": 400, "kept": 400, "drawn": shown.counts()["drawn"]}
    assert shown.picture().max() > 50
    shown.page.keyboard.press("]")
    assert shown.counts()["kept"] == 400
    shown.page.evaluate("location.hash = '#wipe=0.5&other=3&dial=3'")  # a link with a comparison, which needs a dial
    shown.until("document.getElementById('compare').value === 'off'")
    assert shown.page.is_hidden("#wipe")


def test_a_model_that_cannot_be_fetched_is_an_error(tab: Any, save: Any, gaussians: Gaussians) -> None:
    """Keys have no effect then."""
    with serve(save(gaussians)) as url:
        tab.route("**/files/model", lambda route: route.fulfill(body=b"ply\nformat"))
        shown = Shown(tab)
        tab.goto(url)
        tab.wait_for_selector("#message:not([hidden])")
        assert "model.ply" in shown.text("#message") and "truncated" in shown.text("#message")
        assert "truncated" in tab.evaluate("clod.ready.then(() => '', (error) => error.message)")
        for key in "0lvncpe[w+":
            tab.keyboard.press(key)
        tab.wait_for_timeout(100)
        assert shown.errors == [] and shown.text("#target-note") == ""


def test_the_model_is_not_read_as_a_stream(tab: Any, model: Path) -> None:
    """Of streams that a script reads, Chromium reports some as aborted after their last byte."""
    with serve(model) as url:
        tab.add_init_script(
            "Object.defineProperty(Response.prototype, 'body', { get() { throw new Error('a stream') } })"
        )
        ended: list[str] = []
        tab.on("requestfinished", lambda request: ended.append(request.url))
        tab.on("requestfailed", lambda request: ended.append(f"failed: {request.url}"))
        assert Shown(tab).ready(url).errors == []
        assert f"{url}files/model" in ended


def failed(tab: Any, path: Path, script: str) -> str:
    """The error message of the page of a file if ``script`` runs before the page's script."""
    with serve(path) as url:
        tab.add_init_script(script)
        shown = Shown(tab)
        tab.goto(url)
        shown.until("!document.getElementById('message').hidden")
        assert shown.errors == []
        return shown.text("#message")


def test_of_a_model_beyond_the_device_limit_the_dial_leaves_out_some(tab: Any, save: Any) -> None:
    small = """const real = WebGL2RenderingContext.prototype.getParameter;
        WebGL2RenderingContext.prototype.getParameter = function (name) {
            return name === this.MAX_TEXTURE_SIZE ? 2 : real.call(this, name);
        };"""
    tab.add_init_script(small)
    # The first 600 stay longer than the others, at any distance.
    large = scenes.dialled(1100, 3, 5).replace(sigma_d=torch.where(torch.arange(1100) < 600, 1e3, 1e-3))
    for model in (large, large.replace(sigma_d=None, attenuation=None)):
        with serve(save(model)) as url:
            shown = Shown(tab).ready(url)
            assert shown.counts()["total"] == 682
            assert "418 of 1,100 Gaussians do not fit on this graphics device" in shown.text("body")
            if model is large:
                camera = scenes.camera(320, 240)
                shown.camera(camera)
                shown.page.evaluate("clod.setDial(3)")
                kept = int(dial(large, camera, 3.0).keep.sum())
                assert 100 < kept < 600
                shown.until(f"Math.abs(clod.counts().kept - {kept}) <= 1")


def test_without_webgl_the_page_shows_an_error_and_no_panel(tab: Any, model: Path) -> None:
    assert "WebGL2" in failed(tab, model, "HTMLCanvasElement.prototype.getContext = () => null")
    assert tab.is_hidden("#panel")


def test_one_gaussian_fits_the_view(shown: Shown, save: Any) -> None:
    take(shown, save(scenes.gaussians(1, 0, 5).replace(opacity_logits=torch.tensor([5.0])), "one.ply"))
    picture = shown.picture().max(2)
    assert picture.max() > 20 and (picture[0].max(), picture[-1].max()) == (0, 0)


def test_more_gaussians_than_16_bits_count(show: Any, save: Any) -> None:
    count = 100_000
    many = scenes.dialled(count, 0, 6)
    many = many.replace(log_scales=many.log_scales - 3.3)
    shown, camera = show(save(many), "--sv", 3), scenes.camera(320, 240)
    shown.camera(camera)
    kept = int(dial(many, camera, 3.0).keep.sum())
    assert shown.counts()["total"] == count and abs(shown.counts()["kept"] - kept) <= COUNTS * kept
    assert shown.picture().max() > 50


def test_one_file_needs_no_network(
    chromium: Any, show: Any, save: Any, gaussians: Gaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Large data are divided among several elements, because browsers limit the size of a text."""
    monkeypatch.setattr(page, "MAX_CHARACTERS", 20_000)
    monkeypatch.setattr(payload, "BLOCK_ROWS", 100)
    path = save(gaussians)
    served, model = show(path, "--sv", 2), clod_adapter.load(path)
    write_viewer_page(
        tmp_path / "page.html", model, base=model, cameras=scenes.ring(2, 320, 240), virtual_scale=2.0, exact=True
    )
    assert (tmp_path / "page.html").read_text(encoding="utf-8").count('id="clod-model"') > 2
    with chromium.new_context(viewport=SIZE, offline=True) as context:
        alone = Shown(context.new_page()).ready((tmp_path / "page.html").as_uri())
        for shown in (served, alone):
            shown.camera(scenes.camera(320, 240))
        assert np.array_equal(served.picture(), alone.picture()) and served.counts() == alone.counts()
        alone.run("clod.setWipe(0.5, 'base')")
        assert alone.errors == []
        assert [url for url in alone.asked if not url.startswith(("file:", "blob:", "data:"))] == []


def test_a_page_shows_its_spz(chromium: Any, save: Any, artefacts: Path) -> None:
    """What Python reads of it, with growth, in units that float16 does not hold; the picture to wait for goes away."""
    size, model = 1000.0, scenes.dialled(1000, 3, 4, scene_distance=1.0, reference_distance=3.0)
    grown = model.replace(growth_d=torch.linspace(-0.5, 1, 1000))
    far = grown.replace(
        means=size * grown.means, log_scales=grown.log_scales + float(np.log(size)), sigma_d=size * grown.sigma_d,
        attenuation=replace(grown.attenuation, reference_distance=3 * size, eps=size**2 * grown.attenuation.eps),
    )  # fmt: skip
    row = CalibrationRow(1.0, 900.0, 31.5, 0.9, 4.0)
    for name, gaussians, unit in (("near", grown, 1.0), ("far", far, size)):
        path = save(gaussians, f"{name}.ply")
        calibrated = replace(clod_adapter.load(path), calibration=Calibration((row,), 1000, 2, 8, 6, "a machine"))
        camera = scenes.camera(320, 240)
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] *= unit
        seen = replace(camera, viewmat=viewmat)
        read, _ = write_viewer_page(path.with_suffix(".html"), calibrated, cameras=[seen], virtual_scale=1.0)
        with chromium.new_context(viewport=SIZE, offline=True) as context:
            shown = Shown(context.new_page()).ready(path.with_suffix(".html").as_uri())
            assert shown.page.query_selector("#poster") is None and shown.page.is_visible("#dial")
            assert shown.text("#quality") == "31.5 dB" and shown.errors == []
            shown.page.keyboard.press("l")
            here = shown.page.evaluate("location.hash")
            eye = ",".join(str(unit * value) for value in (40, 0, -40))
            for view, quality in ((re.sub("eye=[^&]*", f"eye={eye}", here), ""), (here, "31.5 dB")):
                shown.page.evaluate("hash => { location.hash = hash }", view)
                shown.until(f"document.getElementById('quality').textContent === '{quality}'")
            shown.camera(seen)
            for s in (1.0, 3.0):
                shown.run("clod.setDial(given)", s)
                assert_same(shown, render(read, seen, s), artefacts / f"{name}_{s:g}.png")


def test_the_panel_fits_the_window(show: Any, model: Path, save: Any, plain: Gaussians, artefacts: Path) -> None:
    shown = show(model, "--base", save(plain, "base.ply"))
    shown.run("clod.setWipe(0.5, 'base')")
    for scheme, width in (("light", 360), ("dark", 1280)):
        shown.page.set_viewport_size({"width": width, "height": 640})
        shown.page.emulate_media(color_scheme=scheme)
        shown.page.screenshot(path=artefacts / f"page_{scheme}_{width}.png")
        assert shown.page.evaluate("document.documentElement.scrollWidth") <= width
        box = shown.page.evaluate("document.getElementById('panel').getBoundingClientRect().toJSON()")
        assert box["left"] >= 0 and box["right"] <= width and box["top"] >= 0 and box["bottom"] <= 640
