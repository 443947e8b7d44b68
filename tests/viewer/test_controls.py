"""Keys, pointer, touch, typed counts, links and lists, in a browser."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clod_adapter
import scenes
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.file_formats import write
from models import write_model
from shown import TALL, Shown, drop, fold


def differ(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.abs(one.astype(int) - other).mean() > 0.3)


def test_keys_move_the_dial(shown: Shown) -> None:
    full = shown.counts()["kept"]
    assert shown.text("#dial-value") == "s = 1.00"
    for _ in range(10):
        shown.page.keyboard.press("]")
    fewer = shown.counts()["kept"]
    shown.page.keyboard.press("[")
    assert fewer < shown.counts()["kept"] < full
    shown.page.focus("#dial")
    shown.page.keyboard.press("End")
    assert shown.text("#dial-value") == "s = 5.00" and shown.counts()["kept"] < fewer
    shown.page.keyboard.press("Home")
    assert shown.text("#dial-value") == "all" and shown.counts()["kept"] == 400 > full
    shown.run("clod.setDial(2)")
    shown.page.keyboard.press("e")
    assert shown.counts()["kept"] == 400 and not shown.page.is_checked("#equation")
    assert shown.text("#dial-value") == "off"
    shown.page.keyboard.press("e")
    assert shown.text("#dial-value") == "s = 2.00"


def target(shown: Shown, text: str) -> str:
    """The page's note after a count is entered."""
    shown.page.fill("#target", text)
    shown.page.evaluate("document.getElementById('target-note').textContent = ''")
    shown.page.keyboard.press("Enter")
    shown.until("document.getElementById('target-note').textContent !== ''")
    return shown.text("#target-note")


def test_the_count_box(shown: Shown, gaussians: Gaussians) -> None:
    """A count sets the dial value of ``dial_for``; its note ends with the state that it is about. Keys wait."""
    camera = scenes.camera(320, 240)
    wanted = clod_adapter.dial_for(gaussians, keep=150, cameras=[camera]).virtual_scale
    fold(shown, True)
    shown.camera(camera)
    before = shown.picture()
    shown.page.focus("#target")
    shown.page.keyboard.type("wasdech0")
    assert shown.page.input_value("#target") == "wasdech0" and np.array_equal(shown.picture(), before)
    for text in ("0", "1.5", "many"):
        assert "Enter a number of Gaussians" in target(shown, text) and shown.text("#dial-value") == "s = 1.00"
    assert "keeps" in target(shown, "1,000,000")
    shown.run("clod.setEquation(false)")
    assert "keeps 150 in this view" in target(shown, "150")
    assert shown.counts()["kept"] == 150 and shown.page.is_checked("#equation")
    assert float(shown.text("#dial-value").removeprefix("s = ")) == pytest.approx(wanted, rel=0.02)
    for change in ("]", "ArrowLeft"):
        assert "keeps" in target(shown, "150")
        shown.page.evaluate("document.activeElement.blur()")
        shown.page.keyboard.press(change)
        assert shown.text("#target-note") == "", change


def test_pointer_touch_and_wheel_move_the_camera(chromium: Any, show: Any, model: Path) -> None:
    shown = show(model, context=chromium.new_context(has_touch=True))
    protocol, mouse = shown.page.context.new_cdp_session(shown.page), shown.page.mouse

    def drag() -> None:
        mouse.move(100, 60)
        mouse.down()
        mouse.move(150, 80, steps=3)
        mouse.up()

    def touch(*moves: tuple[tuple[int, int], ...]) -> None:
        for kind, points in zip(("touchStart", "touchMove", "touchEnd"), (*moves, ()), strict=True):
            where = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]
            protocol.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": where})

    fitted = before = shown.picture()
    for move in (
        drag,
        lambda: mouse.wheel(0, 300),
        lambda: touch(((200, 80),), ((260, 100),)),
        lambda: touch(((200, 80), (300, 80)), ((150, 80), (350, 80))),  # a pinch
    ):
        move()
        assert differ(shown.picture(), before)
        before = shown.picture()
    shown.page.keyboard.press("0")
    assert np.array_equal(shown.picture(), fitted)


def test_files_and_cameras_are_listed(show: Any, gaussians: Gaussians, tmp_path: Path) -> None:
    """Switched by keys, lists and a link: view and base stay, and the dial value where the file has it."""
    second = gaussians.replace(sh0=-gaussians.sh0, attenuation=replace(gaussians.attenuation, max_sv=2.0))
    models = {"a.ply": gaussians, "b.glb": second, "c.ply": scenes.dialled(9, 1, 5)}
    for name, model in models.items():
        write(tmp_path / name, model)
    cameras = [replace(camera, name=f"{k}.jpg") for k, camera in enumerate(scenes.ring(3, 320, 240))]
    write_model(tmp_path, cameras, [camera.name for camera in cameras])
    words = [*(tmp_path / name for name in models), "--base", tmp_path / "a.ply", "--images", tmp_path, "--sv", 3]
    shown = show(*words, viewport=TALL)
    assert shown.page.locator("#files option").all_inner_texts() == list(models)
    links = {"0.jpg": shown.link()}
    for key, name in (("n", "1.jpg"), ("n", "2.jpg"), ("n", "0.jpg"), ("p", "2.jpg")):
        shown.page.keyboard.press(key)
        assert shown.page.input_value("#camera") == name
        assert links.setdefault(name, shown.link()) == shown.link()
    assert len({*links.values()}) == 3
    shown.page.select_option("#camera", "1.jpg")
    assert shown.link() == links["1.jpg"]
    shown.page.evaluate("document.activeElement.blur()")
    shown.page.keyboard.press("ArrowRight")
    assert shown.page.input_value("#camera") == "free view"
    shown.page.keyboard.press("2")
    shown.until("document.title === 'b.glb'")
    assert shown.text("#dial-value") == "s = 2.00"
    shown.run("clod.setWipe(0.4)")
    assert shown.text("#wipe-right") == "base · 400"
    linked, of_second = shown.link(), shown.picture()
    shown.run("clod.setWipe(null)")
    drop(shown, "dropped.ply", (tmp_path / "c.ply").read_bytes())
    shown.until("document.title === 'dropped.ply'")
    assert shown.text("#title") == "dropped.ply" and shown.page.input_value("#files") == ""
    assert shown.counts()["total"] == 9 and shown.text("#dial-value") == "s = 3.00"
    shown.page.keyboard.press("1")
    shown.until("document.title === 'a.ply'")
    assert shown.text("#compare-with") == "Compare with the base"
    opened = show(*words, address=linked, viewport=TALL)
    assert opened.page.title() == "b.glb" and not differ(opened.picture(), of_second)
