"""What the page does with keys, files, links and errors, in a real browser."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

import clod_adapter
import scenes
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.view import prepare
from clod_adapter.config import AttenuationConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.scene.colmap import write_model
from clod_adapter.render import dial, render
from clod_adapter.viewer import page, payload
from clod_adapter.viewer.page import write_page
from shown import SIZE, Shown, drop, serve


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    plain = scenes.gaussians(800, 1, 5)
    sigma_d = torch.linspace(0.05, 6, 800)
    return plain.replace(sigma_d=sigma_d, attenuation=AttenuationConfig(tau=0.02, cut="soft", scene_distance=3.0))


def plain_of(gaussians: Gaussians) -> Gaussians:
    return gaussians.replace(sigma_d=None, attenuation=None)


def test_a_file_without_sigma_d_says_why_there_is_no_dial(show: Any, files: Any, gaussians: Gaussians) -> None:
    shown = show(files.save(plain_of(gaussians), "plain.ply"))
    assert shown.page.is_disabled("#dial") and shown.page.is_disabled("#target") and shown.page.is_disabled("#equation")
    said = shown.text("#no-dial")
    assert "plain.ply has no sigma_d" in said and "clod-adapt plain.ply" in said
    assert shown.counts() == {"total": 800, "kept": 800, "drawn": shown.counts()["drawn"]}
    assert shown.picture().max() > 50
    shown.page.keyboard.press("]")
    assert shown.counts()["kept"] == 800


def test_a_broken_file_is_an_error_and_no_blank_page(show: Any, files: Any, gaussians: Gaussians) -> None:
    path = files.save(gaussians)
    data = path.read_bytes()
    broken = (
        ("cut.ply", data[:-100], "truncated"),
        ("head.ply", data[:300], "truncated"),
        ("words.ply", b"good morning", "no splat"),
        ("empty.ply", b"", "empty"),
        ("mesh.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "mesh"),
    )
    shown = show(path)
    before = shown.picture()
    for name, bad, said in broken:
        drop(shown, name, bad)
        shown.page.wait_for_selector("#message:not([hidden])")
        assert name in shown.text("#message") and said in shown.text("#message")
        assert shown.text("#title") == "model.ply"
        shown.page.click("#dismiss")
        assert shown.page.is_hidden("#message")
    assert np.array_equal(shown.picture(), before)


def test_a_model_that_cannot_be_fetched_is_an_error(chromium: Any, files: Any, gaussians: Gaussians) -> None:
    with serve(files.save(gaussians)) as url, chromium.new_context() as context:
        page = context.new_page()
        page.route("**/files/model", lambda route: route.fulfill(body=b"ply\nformat"))
        shown = Shown(page)
        page.goto(url)
        page.wait_for_selector("#message:not([hidden])")
        assert "model.ply" in shown.text("#message") and "truncated" in shown.text("#message")
        assert "truncated" in page.evaluate("clod.ready.then(() => '', (error) => error.message)")
        assert shown.errors == []


def test_a_dropped_file_is_shown(show: Any, files: Any, gaussians: Gaussians) -> None:
    """Whichever form its numbers have."""
    path = files.save(gaussians, "model.ply")
    given, plain = show(path), show(files.save(plain_of(gaussians), "plain.ply"))
    camera = scenes.camera(320, 240)
    given.camera(camera)
    given.run("clod.setDial(2)")
    wanted = given.picture()
    vertex = PlyData.read(str(path), mmap=False)["vertex"]
    doubles = vertex.data.astype([(name, "f8") for name in vertex.data.dtype.names])
    forms: dict[str, dict[str, Any]] = {"ascii.ply": {"text": True}, "big.ply": {"byte_order": ">"}, "doubles.ply": {}}
    for name, options in forms.items():
        rows = doubles if name == "doubles.ply" else vertex.data
        PlyData([PlyElement.describe(rows, "vertex", comments=vertex.comments)], **options).write(
            str(files.folder / name)
        )
        drop(plain, name, (files.folder / name).read_bytes())
        plain.until(f"document.title === '{name}'")
        plain.camera(camera)
        plain.run("clod.setDial(2)")
        assert plain.page.is_enabled("#dial") and np.array_equal(plain.picture(), wanted), name


@pytest.mark.parametrize(
    "settings", [{}, {"tau": 1 / 255, "cut": "hard", "normalizer": "max"}, {"tau": 0.013}], ids=str
)
def test_a_dropped_file_without_comments_keeps_its_dial(
    show: Any, files: Any, gaussians: Gaussians, settings: dict[str, Any]
) -> None:
    """As other tools leave it: the columns are all that says how sigma_d is read."""
    model = gaussians.replace(attenuation=AttenuationConfig(**settings))
    path = files.save(model, "model.ply")
    given, plain = show(path), show(files.save(plain_of(gaussians), "plain.ply"))
    camera = scenes.camera(320, 240)
    rows = PlyData.read(str(path), mmap=False)["vertex"].data
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(files.folder / "bare.ply"))
    drop(plain, "bare.ply", (files.folder / "bare.ply").read_bytes())
    plain.until("document.title === 'bare.ply'")
    for shown in (given, plain):
        shown.camera(camera)
        shown.run("clod.setDial(1.5)")
    kept = int(render(model, camera, 1.5).kept.sum())
    assert given.counts()["kept"] == plain.counts()["kept"] == kept and 0 < kept < 800
    assert np.array_equal(plain.picture(), given.picture())


def test_a_dropped_file_of_an_earlier_version_has_the_defaults_of_then(
    show: Any, files: Any, gaussians: Gaussians
) -> None:
    rows = PlyData.read(str(files.save(gaussians)), mmap=False)["vertex"].data
    old, plain = files.folder / "old.ply", show(files.save(plain_of(gaussians), "plain.ply"))
    PlyData([PlyElement.describe(rows, "vertex", comments=["clod_adapter max_sv 4.0"])]).write(str(old))
    drop(plain, "old.ply", old.read_bytes())
    plain.until("document.title === 'old.ply'")
    plain.camera(scenes.camera(320, 240))
    plain.run("clod.setDial(1.5)")
    kept = int(render(clod_adapter.load(old).gaussians, scenes.camera(320, 240), 1.5).kept.sum())
    assert plain.counts()["kept"] == kept and 0 < kept < 800


def test_a_name_is_text_on_the_page(show: Any, files: Any, gaussians: Gaussians) -> None:
    name = "<img src=x onerror=clod=1><script>clod=1<!script>&amp;'\".ply"
    shown = show(files.save(plain_of(gaussians), name))
    assert shown.text("#title") == name and shown.page.title() == name and name in shown.text("#no-dial")
    assert shown.page.query_selector("img") is None


def test_half_a_million_gaussians_load(show: Any, files: Any) -> None:
    count = 500_000
    many = scenes.gaussians(count, 0, 6, size=0.003)
    sigma_d = torch.randn(count, generator=torch.Generator().manual_seed(0)).exp()
    many = many.replace(sigma_d=sigma_d, attenuation=AttenuationConfig(tau=0.02, cut="soft", scene_distance=3.0))
    shown, camera = show(files.save(many), "--sv", 3), scenes.camera(320, 240)
    shown.camera(camera)
    kept = int(dial(many, camera, 3.0).keep.sum())
    assert shown.counts()["total"] == count and abs(shown.counts()["kept"] - kept) <= 1e-3 * kept
    assert shown.picture().max() > 50


def test_keys_move_the_dial(show: Any, files: Any, gaussians: Gaussians) -> None:
    shown = show(files.save(gaussians))
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
    assert shown.counts()["kept"] == full
    shown.page.keyboard.press("e")
    assert shown.counts()["kept"] == 800 and not shown.page.is_checked("#equation")


def test_a_dial_beyond_the_trained_is_said(files: Any, gaussians: Gaussians) -> None:
    path = str(files.save(gaussians))
    for sv, said in (
        ("5", []),
        ("9", ["the page's dial ends at s = 5, the largest value trained for, and opens there"]),
    ):
        assert prepare(build_parser("view").parse_args([path, "--sv", sv]), Console(quiet=True))[1]["notes"] == said


def test_a_count_is_kept_to(show: Any, files: Any, gaussians: Gaussians) -> None:
    shown, camera = show(files.save(gaussians), viewport={"width": 1000, "height": 760}), scenes.camera(320, 240)
    shown.camera(camera)
    wanted = clod_adapter.dial_for(gaussians, keep=300, cameras=[camera]).virtual_scale
    shown.page.fill("#target", "300")
    shown.page.keyboard.press("Enter")
    shown.until("document.getElementById('dial-value').textContent !== 's = 1.00'")
    assert shown.counts()["kept"] == 300
    assert shown.text("#dial-value") == f"s = {wanted:.2f}"


def test_pointer_and_wheel_move_the_camera(show: Any, files: Any, gaussians: Gaussians) -> None:
    shown = show(files.save(gaussians))
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
    for one, other in zip(pictures, pictures[1:], strict=False):
        assert np.abs(one.astype(int) - other).mean() > 1
    assert np.array_equal(pictures[0], pictures[-1])


def test_fingers_move_the_camera(show: Any, files: Any, gaussians: Gaussians) -> None:
    shown = show(files.save(gaussians), has_touch=True)
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
        assert np.abs(pictures[-1].astype(int) - pictures[-2]).mean() > 1


def test_a_link_restores_the_view(show: Any, files: Any, gaussians: Gaussians) -> None:
    words = [files.save(gaussians), "--base", files.save(plain_of(gaussians), "base.ply")]
    shown = show(*words)
    for script in ("clod.setDial(2.5)", "clod.setWipe(0.3, 'base')"):
        shown.run(script)
    shown.page.mouse.move(100, 60)
    shown.page.mouse.down()
    shown.page.mouse.move(160, 90, steps=3)
    shown.page.mouse.up()
    shown.page.keyboard.press("l")
    shown.until("location.hash !== ''")
    again = show(*words, address=shown.page.evaluate("location.hash"))
    assert again.text("#dial-value") == "s = 2.50" and again.counts() == shown.counts()
    assert np.abs(shown.picture().astype(int) - again.picture()).mean() < 0.05  # the link has seven digits
    assert again.page.input_value("#compare") == "base"


def test_cameras_of_the_scene(show: Any, files: Any, gaussians: Gaussians, tmp_path: Path) -> None:
    cameras = [replace(camera, name=f"{k}.jpg") for k, camera in enumerate(scenes.ring(3, 320, 240))]
    write_model(tmp_path, cameras, [camera.name for camera in cameras])
    shown = show(files.save(gaussians), "--images", tmp_path)
    views = []
    for key in ("", "n", "n", "n", "p"):
        if key:
            shown.page.keyboard.press(key)
        views.append(shown.picture())
    same = [[bool(np.abs(a.astype(int) - b).mean() < 0.5) for b in views] for a in views]
    assert same[0] == [True, False, False, True, False] and same[2] == [False, False, True, False, True]


def test_one_file_holds_more_than_one_text_may(
    chromium: Any, files: Any, gaussians: Gaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In elements that follow each other."""
    monkeypatch.setattr(page, "LETTERS", 40_000)
    monkeypatch.setattr(payload, "ROWS", 100)
    write_page(tmp_path / "page.html", clod_adapter.load(files.save(gaussians)))
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert text.count('id="clod-model"') > 2
    with chromium.new_context(viewport=SIZE) as context:
        shown = Shown(context.new_page()).ready((tmp_path / "page.html").as_uri())
        assert shown.counts()["total"] == 800 and shown.errors == []


def test_one_file_needs_no_network(chromium: Any, show: Any, files: Any, gaussians: Gaussians, tmp_path: Path) -> None:
    path = files.save(gaussians)
    served = show(path, "--sv", 2)
    model = clod_adapter.load(path)
    write_page(tmp_path / "page.html", model, base=model, cameras=scenes.ring(2, 320, 240), virtual_scale=2.0)
    with chromium.new_context(viewport=SIZE, offline=True) as context:
        alone = Shown(context.new_page()).ready((tmp_path / "page.html").as_uri())
        for shown in (served, alone):
            shown.camera(scenes.camera(320, 240))
        assert np.array_equal(served.picture(), alone.picture()) and served.counts() == alone.counts()
        alone.run("clod.setWipe(0.5, 'base')")
        assert alone.errors == []
        assert [url for url in alone.asked if not url.startswith(("file:", "blob:", "data:"))] == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1280])
def test_the_page_fits(show: Any, files: Any, gaussians: Gaussians, artefacts: Path, scheme: str, width: int) -> None:
    options = {"viewport": {"width": width, "height": 640}, "color_scheme": scheme}
    shown = show(files.save(gaussians), "--base", files.save(plain_of(gaussians), "base.ply"), **options)
    shown.run("clod.setWipe(0.5, 'base')")
    shown.page.screenshot(path=artefacts / f"page_{scheme}_{width}.png")
    assert shown.page.evaluate("document.documentElement.scrollWidth") <= width
    box = json.loads(shown.page.evaluate("JSON.stringify(document.getElementById('panel').getBoundingClientRect())"))
    assert box["left"] >= 0 and box["right"] <= width and box["top"] >= 0 and box["bottom"] <= 640
