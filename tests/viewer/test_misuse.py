"""The page with fast or invalid input, and on devices without the needed WebGL2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

import clod_adapter
import scenes
from clod_adapter.gaussians import Gaussians
from shown import Shown, drop, fold, serve, take


def target(shown: Shown, text: str | None = None) -> str:
    """The page's note after a count is entered; None enters the same again."""
    if text is not None:
        shown.page.fill("#target", text)
    shown.page.evaluate("document.getElementById('target-note').textContent = ''")
    shown.page.keyboard.press("Enter")
    shown.until("document.getElementById('target-note').textContent !== ''")
    return shown.text("#target-note")


def test_the_last_of_two_dropped_files_is_shown(shown: Shown, files: Any, model: Path) -> None:
    one = files.save(scenes.gaussians(9, 0, 1), "nine.ply")
    drop(shown, "slow.ply", model.read_bytes(), wait=200)
    drop(shown, "nine.ply", one.read_bytes())
    shown.until("document.title === 'nine.ply'")
    shown.page.wait_for_timeout(400)
    assert shown.text("#title") == "nine.ply" and shown.counts()["total"] == 9


def test_keys(shown: Shown) -> None:
    """A key released after Shift (on many keyboards + is Shift and =); keys with the focus on text or the dial."""
    fold(shown, True)
    shown.page.evaluate("""() => {
        const press = (kind, key) => new KeyboardEvent(kind, { key, code: "Equal", bubbles: true });
        const canvas = document.getElementById("canvas");
        for (const event of [press("keydown", "+"), press("keyup", "=")]) canvas.dispatchEvent(event);
    }""")
    shown.page.wait_for_timeout(100)
    before = shown.picture()
    assert np.array_equal(shown.picture(), before)
    shown.page.focus("#target")
    shown.page.keyboard.type("wasdech0")
    assert shown.page.input_value("#target") == "wasdech0" and np.array_equal(shown.picture(), before)
    shown.page.focus("#dial")
    shown.page.keyboard.press("w")
    assert not np.array_equal(shown.picture(), before)


def test_the_count_box_takes_counts_only(shown: Shown, gaussians: Gaussians) -> None:
    """A valid count sets the dial value of ``dial_for``."""
    camera = scenes.camera(320, 240)
    wanted = clod_adapter.dial_for(gaussians, keep=150, cameras=[camera]).virtual_scale
    fold(shown, True)
    shown.camera(camera)
    for text in ("0", "-5", "1.5", "many"):
        assert "Enter a number of Gaussians" in target(shown, text) and shown.text("#dial-value") == "s = 1.00"
    assert "keeps" in target(shown, "1,000,000")
    shown.run("clod.setEquation(false)")
    assert "keeps 150 in this view" in target(shown, "150")
    assert shown.counts()["kept"] == 150 and shown.page.is_checked("#equation")
    assert shown.text("#dial-value") == f"s = {wanted:.2f}"
    shown.run("clod.setDial(1)")
    assert target(shown) and shown.counts()["kept"] == 150


def test_one_gaussian_fits_the_view(shown: Shown, files: Any) -> None:
    take(shown, files.save(scenes.gaussians(1, 0, 5).replace(opacity_logits=torch.tensor([5.0])), "one.ply"))
    picture = shown.picture().max(2)
    assert picture.max() > 20 and (picture[0].max(), picture[-1].max()) == (0, 0)


def failed(tab: Any, path: Path, script: str) -> str:
    """The error message of the page of a file if ``script`` runs before the page's script."""
    with serve(path) as url:
        tab.add_init_script(script)
        shown = Shown(tab)
        tab.goto(url)
        shown.until("!document.getElementById('message').hidden")
        assert shown.errors == []
        return shown.text("#message")


def test_a_model_beyond_the_device_limit_is_an_error_with_both_counts(tab: Any, files: Any) -> None:
    small = """const real = WebGL2RenderingContext.prototype.getParameter;
        WebGL2RenderingContext.prototype.getParameter = function (name) {
            return name === this.MAX_TEXTURE_SIZE ? 2 : real.call(this, name);
        };"""
    error = failed(tab, files.save(scenes.gaussians(1100, 3, 5)), small)
    assert "1,100 Gaussians" in error and "at most 682" in error


def test_without_webgl_the_page_shows_an_error_and_no_panel(tab: Any, model: Path) -> None:
    assert "WebGL2" in failed(tab, model, "HTMLCanvasElement.prototype.getContext = () => null")
    assert tab.is_hidden("#panel")
