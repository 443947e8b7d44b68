"""Keys, pointer, touch, typed counts, links and the list of cameras, in a browser."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import clod_adapter
import scenes
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.scene.colmap import write_model
from shown import TALL, Shown, drop, fold


def test_keys_move_the_dial(shown: Shown) -> None:
    assert shown.text("#dial-value") == "s = 1.00"
    full = shown.counts()["kept"]
    for _ in range(10):
        shown.page.keyboard.press("]")
    fewer = shown.counts()["kept"]
    assert fewer < full and shown.text("#dial-value") != "s = 1.00"
    shown.page.keyboard.press("[")
    assert fewer < shown.counts()["kept"] < full
    shown.page.focus("#dial")
    shown.page.keyboard.press("End")
    assert shown.text("#dial-value") == "s = 5.00" and shown.counts()["kept"] < fewer
    shown.page.keyboard.press("Home")
    assert shown.text("#dial-value") == "all" and shown.counts()["kept"] == 400 > full
    shown.page.keyboard.press("e")
    assert shown.counts()["kept"] == 400 and not shown.page.is_checked("#equation")
    assert shown.text("#dial-value") == "off" and shown.page.text_content("label:has(#equation)") == " Apply dial"
    shown.page.keyboard.press("e")
    assert shown.text("#dial-value") == "all"


def test_keys_by_modifier_and_focus(shown: Shown) -> None:
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


def target(shown: Shown, text: str | None = None) -> str:
    """The page's note after a count is entered; None enters the same again."""
    if text is not None:
        shown.page.fill("#target", text)
    shown.page.evaluate("document.getElementById('target-note').textContent = ''")
    shown.page.keyboard.press("Enter")
    shown.until("document.getElementById('target-note').textContent !== ''")
    return shown.text("#target-note")


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


def differ(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.abs(one.astype(int) - other).mean() > 0.3)


def test_pointer_and_wheel_move_the_camera(shown: Shown) -> None:
    pictures = [shown.picture()]
    mouse = shown.page.mouse
    mouse.move(100, 60)
    mouse.down()
    mouse.move(150, 80, steps=3)
    mouse.up()
    pictures.append(shown.picture())
    mouse.wheel(0, 300)
    pictures.append(shown.picture())
    shown.page.keyboard.press("0")
    pictures.append(shown.picture())
    assert all(differ(one, other) for one, other in pairwise(pictures))
    assert np.array_equal(pictures[0], pictures[-1])


def test_touch_moves_the_camera(chromium: Any, show: Any, model: Path) -> None:
    shown = show(model, context=chromium.new_context(has_touch=True))
    protocol = shown.page.context.new_cdp_session(shown.page)

    def touch(kind: str, *points: tuple[int, int]) -> None:
        where = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]
        protocol.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": where})

    pictures = [shown.picture()]
    for moves in ([((200, 80),), ((260, 100),)], [((200, 80), (300, 80)), ((150, 80), (350, 80))]):  # a turn, a pinch
        touch("touchStart", *moves[0])
        touch("touchMove", *moves[1])
        touch("touchEnd")
        pictures.append(shown.picture())
        assert differ(pictures[-1], pictures[-2])


def test_a_link_opens_the_same_view(show: Any, model: Path) -> None:
    shown = show(model)
    fitted = shown.picture()
    for key in ("ArrowRight", "-", "]"):
        shown.page.keyboard.press(key)
    shown.run("clod.setWipe(0.4, 3)")
    shown.page.keyboard.press("l")
    opened = show(model, address=shown.page.evaluate("location.hash"))
    assert not differ(opened.picture(), shown.picture()) and differ(opened.picture(), fitted)
    assert opened.counts() == shown.counts() and opened.text("#wipe-right") == shown.text("#wipe-right")


def test_cameras_of_the_scene(show: Any, model: Path, tmp_path: Path) -> None:
    """Selected by keys and by name in the list; after the view moves, the list has no selection."""
    cameras = [replace(camera, name=f"{k}.jpg") for k, camera in enumerate(scenes.ring(3, 320, 240))]
    write_model(tmp_path, cameras, [camera.name for camera in cameras])
    shown = show(model, "--images", tmp_path, viewport=TALL)
    views = []
    for key, name in (("", 0), ("n", 1), ("n", 2), ("n", 0), ("p", 2)):
        if key:
            shown.page.keyboard.press(key)
        assert shown.page.input_value("#camera") == f"{name}.jpg"
        views.append(shown.picture())
    same = [[not differ(a, b) for b in views] for a in views]
    assert same[0] == [True, False, False, True, False] and same[2] == [False, False, True, False, True]
    shown.page.select_option("#camera", "1.jpg")
    assert np.array_equal(shown.picture(), views[1])
    shown.page.mouse.move(500, 60)
    shown.page.mouse.wheel(0, 200)
    shown.until("document.getElementById('camera').value === 'free view'")


RING = "getComputedStyle(document.getElementById('canvas')).outlineStyle !== 'none'"


def test_the_focus_ring_is_of_the_keyboard(show: Any, model: Path) -> None:
    """A drag leaves no ring round the canvas, nor do keys after it; Tab shows it."""
    shown = show(model)
    mouse = shown.page.mouse
    mouse.move(100, 60)
    mouse.down()
    mouse.move(150, 80, steps=3)
    mouse.up()
    for key in ("", "ArrowLeft"):
        if key:
            shown.page.keyboard.press(key)
        assert shown.page.evaluate("document.activeElement.id") == "canvas" and not shown.page.evaluate(RING)
    shown.page.keyboard.press("Tab")
    shown.page.keyboard.press("Shift+Tab")
    assert shown.page.evaluate("document.activeElement.id") == "canvas" and shown.page.evaluate(RING)


def test_a_note_ends_with_the_state_that_it_is_about(shown: Shown) -> None:
    fold(shown, True)
    assert shown.page.get_attribute("#target", "placeholder") == "e.g. 200"
    shown.run("clod.setDial(1)")
    for change in ("]", "e", "ArrowLeft", "0"):
        assert "keeps" in target(shown, "150")
        shown.page.evaluate("document.activeElement.blur()")
        shown.page.keyboard.press(change)
        assert shown.text("#target-note") == "", change


def test_another_dial_value_differs_from_the_present_one(shown: Shown) -> None:
    """Whatever was compared before; and the dial is on, without which both halves would be the same."""
    fold(shown, True)
    for dial, other in ((1, 5), (5, 1), (2, 5), (4, 1)):
        shown.page.select_option("#compare", "off")
        shown.run("clod.setWipe(null, given)", dial)  # compared last time
        shown.run("clod.setDial(given)", dial)
        shown.run("clod.setEquation(false)")
        shown.page.select_option("#compare", "dial")
        assert shown.text("#other-value") == f"s = {other:.2f}" and shown.page.is_checked("#equation")
    shown.run("clod.setEquation(false)")
    shown.page.select_option("#compare", "base")
    assert "dial off" in shown.text("#wipe-right") and shown.page.is_checked("#equation")
    assert "quation" not in shown.page.inner_text("body") + str(shown.page.text_content("#help"))


def test_several_files_are_switched_in_the_same_view(
    show: Any, save: Any, gaussians: Gaussians, tmp_path: Path
) -> None:
    """By the list, by their numbers and by a link; the dial value stays where the file has it. The base stays too."""
    second = gaussians.replace(sh0=-gaussians.sh0, attenuation=replace(gaussians.attenuation, max_sv=2.0))
    models = {"a.ply": gaussians, "b.ply": second, "c.ply": scenes.dialled(9, 1, 5)}
    words = [*(save(model, name) for name, model in models.items()), "--base", tmp_path / "a.ply"]
    shown = show(*words, "--sv", 3, viewport=TALL)
    assert shown.page.locator("#files option").all_inner_texts() == list(models)
    for _ in range(3):
        shown.page.keyboard.press("ArrowRight")
    first = shown.picture()
    shown.page.keyboard.press("2")
    shown.until("document.title === 'b.ply'")
    assert not np.array_equal(shown.picture(), first) and shown.text("#dial-value") == "s = 2.00"
    shown.run("clod.setWipe(0.5, 'base')")
    assert shown.text("#wipe-right") == "base · 400"
    shown.run("clod.setWipe(null)")
    shown.page.keyboard.press("l")
    hashed, of_second = shown.page.evaluate("location.hash"), shown.picture()
    assert "file=2" in hashed
    shown.page.select_option("#files", "c.ply")
    shown.until("document.title === 'c.ply'")
    assert shown.counts()["total"] == 9
    shown.page.keyboard.press("1")
    shown.until("document.title === 'a.ply'")
    shown.run("clod.setDial(3)")
    assert np.array_equal(shown.picture(), first)
    drop(shown, "dropped.ply", (tmp_path / "c.ply").read_bytes())
    shown.until("document.title === 'dropped.ply'")
    assert shown.text("#title") == "dropped.ply" and shown.page.input_value("#files") == ""
    shown.page.keyboard.press("2")
    shown.until("document.title === 'b.ply'")
    assert shown.page.inner_text("#compare option:nth-child(2)") == "with the base"
    opened = show(*words, address=hashed, viewport=TALL)
    assert opened.page.title() == "b.ply" and not differ(opened.picture(), of_second)
    one = show(words[0], viewport=TALL)
    assert one.page.is_hidden("#files") and one.text("#title") == "a.ply"
