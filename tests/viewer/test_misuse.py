"""The page under hands that are quick, careless, or on a device that cannot."""

from __future__ import annotations

import base64
import gzip
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import scenes
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.scene.colmap import write_model
from shown import Shown, serve

TALL = {"width": 640, "height": 600}  # the whole panel is shown

DROP = """([name, data, wait, fails]) => {
    const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
    const file = new File([bytes], name), read = file.arrayBuffer.bind(file);
    const later = new Promise((resolve) => setTimeout(resolve, wait));
    file.arrayBuffer = () => later.then(() => fails ? Promise.reject(new DOMException("", "NotFoundError")) : read());
    const event = new Event("drop", { bubbles: true, cancelable: true });
    event.dataTransfer = { files: [file] };
    document.body.dispatchEvent(event);
}"""


def drop(shown: Shown, name: str, data: bytes, *, wait: int = 0, fails: bool = False) -> None:
    """Lets a file fall on the page that can be read after ``wait`` milliseconds, or never."""
    shown.page.evaluate(DROP, [name, base64.b64encode(data).decode(), wait, fails])


def target(shown: Shown, text: str) -> str:
    """What the page says to a count that was typed."""
    shown.page.fill("#target", text)
    shown.page.evaluate("document.getElementById('target-note').textContent = ''")
    shown.page.keyboard.press("Enter")
    shown.until("document.getElementById('target-note').textContent !== ''")
    return shown.text("#target-note")


def test_of_files_dropped_at_once_the_last_is_shown(show: Any, files: Any, gaussians: Gaussians) -> None:
    path, one = files.save(gaussians), files.save(scenes.gaussians(9, 0, 1), "nine.ply")
    shown = show(path)
    drop(shown, "slow.ply", path.read_bytes(), wait=200)
    drop(shown, "nine.ply", one.read_bytes())
    shown.until("document.title === 'nine.ply'")
    shown.page.wait_for_timeout(400)
    assert shown.text("#title") == "nine.ply" and shown.counts()["total"] == 9


def test_what_no_reader_foresaw_is_said_in_words(show: Any, files: Any, gaussians: Gaussians) -> None:
    shown = show(files.save(gaussians))
    drop(shown, "folder", b"", fails=True)
    shown.until("!document.getElementById('message').hidden")
    assert "folder" in shown.text("#message") and "cannot read it" in shown.text("#message")
    for name, data in (
        ("cut.spz", gzip.compress(bytes(100), mtime=0)[:-9]),
        ("end.sog", b"PK\3\4" + bytes(60) + b"PK\5\6" + b"\xff" * 20),
    ):
        drop(shown, name, data)
        shown.until(f"document.getElementById('message').textContent.includes('{name}')")
        assert "it is damaged, or too large" in shown.text("#message")


def test_a_key_is_let_go_whatever_shift_made_of_it(show: Any, files: Any, gaussians: Gaussians) -> None:
    """On many keyboards + is Shift and =, and Shift may be let go first."""
    shown = show(files.save(gaussians))
    shown.page.evaluate("""() => {
        const press = (kind, key) => new KeyboardEvent(kind, { key, code: "Equal", bubbles: true });
        const canvas = document.getElementById("canvas");
        for (const event of [press("keydown", "+"), press("keyup", "=")]) canvas.dispatchEvent(event);
    }""")
    shown.page.wait_for_timeout(100)
    before = shown.picture()
    assert np.array_equal(shown.picture(), before)


def test_letters_move_from_the_dial_too_and_are_text_in_a_text(show: Any, files: Any, gaussians: Gaussians) -> None:
    shown = show(files.save(gaussians), viewport=TALL)
    before = shown.picture()
    shown.page.focus("#target")
    shown.page.keyboard.type("wasdech0")
    assert shown.page.input_value("#target") == "wasdech0" and np.array_equal(shown.picture(), before)
    shown.page.focus("#dial")
    shown.page.keyboard.press("w")
    assert not np.array_equal(shown.picture(), before)


def test_the_box_takes_counts_alone_and_the_same_again(show: Any, files: Any, gaussians: Gaussians) -> None:
    shown = show(files.save(gaussians), viewport=TALL)
    for text in ("0", "-5", "1.5", "many"):
        assert "A number of Gaussians" in target(shown, text) and shown.text("#dial-value") == "s = 1.00"
    assert "keeps" in target(shown, "1,000,000")
    shown.run("clod.setEquation(false)")
    assert "keeps 150 in this view" in target(shown, "150")
    assert shown.counts()["kept"] == 150 and shown.page.is_checked("#equation")
    shown.run("clod.setDial(1)")
    shown.page.evaluate("document.getElementById('target-note').textContent = ''")
    shown.page.keyboard.press("Enter")
    shown.until("document.getElementById('target-note').textContent !== ''")
    assert shown.counts()["kept"] == 150


def test_a_link_without_its_comparison_shows_none(show: Any, files: Any, plain: Gaussians) -> None:
    shown = show(files.save(plain), address="#wipe=0.5&other=3&dial=3")
    assert shown.page.is_hidden("#wipe") and shown.page.input_value("#compare") == "off"


def test_cameras_can_be_chosen_by_name(show: Any, files: Any, gaussians: Gaussians, tmp_path: Path) -> None:
    cameras = [replace(camera, name=f"{k}.jpg") for k, camera in enumerate(scenes.ring(3, 320, 240))]
    write_model(tmp_path, cameras, [camera.name for camera in cameras])
    shown = show(files.save(gaussians), "--images", tmp_path, viewport=TALL)
    assert shown.page.input_value("#camera") == "0.jpg"
    shown.page.keyboard.press("n")
    assert shown.page.input_value("#camera") == "1.jpg"
    wanted = shown.picture()
    shown.page.keyboard.press("p")
    shown.page.select_option("#camera", "1.jpg")
    assert np.array_equal(shown.picture(), wanted)
    shown.page.mouse.move(500, 60)
    shown.page.mouse.wheel(0, 200)
    shown.until("document.getElementById('camera').selectedIndex === -1")


def test_one_gaussian_is_seen_whole(show: Any, files: Any) -> None:
    lone = scenes.gaussians(1, 0, 5).replace(opacity_logits=torch.tensor([5.0]))
    picture = show(files.save(lone)).picture().max(2)
    assert picture.max() > 20 and (picture[0].max(), picture[-1].max()) == (0, 0)


def test_a_model_beyond_the_device_limit_is_an_error_with_both_counts(tab: Any, files: Any) -> None:
    small = """const real = WebGL2RenderingContext.prototype.getParameter;
        WebGL2RenderingContext.prototype.getParameter = function (name) {
            return name === this.MAX_TEXTURE_SIZE ? 2 : real.call(this, name);
        };"""
    with serve(files.save(scenes.gaussians(1100, 3, 5))) as url:
        tab.add_init_script(small)
        shown = Shown(tab)
        tab.goto(url)
        shown.until("!document.getElementById('message').hidden")
        assert "1,100 Gaussians" in shown.text("#message") and "takes 682" in shown.text("#message")


def test_without_webgl_there_is_a_message_and_no_panel(tab: Any, files: Any, plain: Gaussians) -> None:
    with serve(files.save(plain)) as url:
        tab.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
        shown = Shown(tab)
        tab.goto(url)
        shown.until("!document.getElementById('message').hidden")
        assert "WebGL2" in shown.text("#message") and shown.page.is_hidden("#panel")
        assert shown.errors == []
