"""The page under hands that are quick, careless, or on a device that cannot."""

from __future__ import annotations

import base64
import gzip
from pathlib import Path
from typing import Any

import numpy as np
import torch

import scenes
from clod_adapter.gaussians import Gaussians
from shown import Shown, fold, serve, take

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


def test_of_files_dropped_at_once_the_last_is_shown(shown: Shown, files: Any, model: Path) -> None:
    one = files.save(scenes.gaussians(9, 0, 1), "nine.ply")
    drop(shown, "slow.ply", model.read_bytes(), wait=200)
    drop(shown, "nine.ply", one.read_bytes())
    shown.until("document.title === 'nine.ply'")
    shown.page.wait_for_timeout(400)
    assert shown.text("#title") == "nine.ply" and shown.counts()["total"] == 9


def test_what_no_reader_foresaw_is_said_in_words(shown: Shown) -> None:
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


def test_a_key_is_let_go_whatever_shift_made_of_it(shown: Shown) -> None:
    """On many keyboards + is Shift and =, and Shift may be let go first."""
    shown.page.evaluate("""() => {
        const press = (kind, key) => new KeyboardEvent(kind, { key, code: "Equal", bubbles: true });
        const canvas = document.getElementById("canvas");
        for (const event of [press("keydown", "+"), press("keyup", "=")]) canvas.dispatchEvent(event);
    }""")
    shown.page.wait_for_timeout(100)
    before = shown.picture()
    assert np.array_equal(shown.picture(), before)


def test_letters_move_from_the_dial_too_and_are_text_in_a_text(shown: Shown) -> None:
    fold(shown, True)
    before = shown.picture()
    shown.page.focus("#target")
    shown.page.keyboard.type("wasdech0")
    assert shown.page.input_value("#target") == "wasdech0" and np.array_equal(shown.picture(), before)
    shown.page.focus("#dial")
    shown.page.keyboard.press("w")
    assert not np.array_equal(shown.picture(), before)


def test_the_box_takes_counts_alone_and_the_same_again(shown: Shown) -> None:
    fold(shown, True)
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


def test_one_gaussian_is_seen_whole(shown: Shown, files: Any) -> None:
    take(shown, files.save(scenes.gaussians(1, 0, 5).replace(opacity_logits=torch.tensor([5.0])), "one.ply"))
    picture = shown.picture().max(2)
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
