"""Orbit centre, up axis, framing, animations, pictures and videos, removed Gaussians and headsets, in a browser."""

from __future__ import annotations

import base64
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import clod_adapter
import scenes
from clod_adapter.calibration import Calibration, CalibrationRow
from clod_adapter.cameras import Camera
from clod_adapter.equation.attenuation import dial
from clod_adapter.equation.distances import viewpoint_of
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.scene.colmap import write_model
from clod_adapter.render import render
from clod_adapter.viewer.page import write_viewer_page
from shown import REAL_GPU, SIZE, TALL, Shown, assert_alike, serve, sorts_on_gpu, take

C0 = 0.28209479177387814
ORANGE = np.array([1.0, 0.42, 0.05])


def link(shown: Shown) -> dict[str, np.ndarray]:
    """The numbers of the link to the present view."""
    shown.page.keyboard.press("l")
    parts = shown.page.evaluate("location.hash").lstrip("#").split("&")
    return {name: np.array([float(v) for v in text.split(",")]) for name, text in (part.split("=") for part in parts)}


def forward(view: dict[str, np.ndarray]) -> np.ndarray:
    return np.cross(view["axes"][:3], view["axes"][3:])


def points(means: Any, size: float, sh0: Any = None) -> Gaussians:
    """Opaque balls."""
    means = torch.as_tensor(means, dtype=torch.float32)
    model, opaque = scenes.gaussians(len(means), 0, 1), torch.full((len(means),), 6.0)
    return model.replace(
        means=means, log_scales=torch.full_like(means, float(np.log(size))), opacity_logits=opaque,
        sh0=model.sh0 if sh0 is None else torch.as_tensor(sh0, dtype=torch.float32)[:, None],
    )  # fmt: skip


def test_double_click_sets_the_orbit_centre(show: Any, save: Any) -> None:
    """The camera turns to the nearest surface there, and stays where it is; a double click on nothing has no effect."""
    where = np.array([[0.5, 0.2, 2.0], [0.5, 0.2, 4.0], [-1.0, 0, 3.0]])
    shown = show(save(points(where, 0.05)), viewport=TALL)
    camera = scenes.camera(640, 600)
    shown.camera(camera)
    seen = camera.K @ (camera.viewmat[:3, :3] @ torch.tensor(where[0]).float() + camera.viewmat[:3, 3])
    shown.page.mouse.dblclick(630, 10)
    shown.page.wait_for_timeout(600)
    before = link(shown)
    shown.page.mouse.dblclick(float(seen[0] / seen[2]), float(seen[1] / seen[2]))
    shown.page.wait_for_timeout(1000)
    after, ray = link(shown), where[0] - before["eye"]
    assert np.allclose(after["eye"], before["eye"], atol=1e-4)
    assert abs(after["distance"][0] - np.linalg.norm(ray)) < 0.1
    assert forward(before) @ ray / np.linalg.norm(ray) < 0.999 < 0.9999 < forward(after) @ ray / np.linalg.norm(ray)
    shown.page.mouse.dblclick(630, 10)
    shown.page.wait_for_timeout(600)
    assert np.allclose(link(shown)["axes"], after["axes"])


ANGLE = np.radians(25)
TURN = np.array([[1, 0, 0], [0, np.cos(ANGLE), -np.sin(ANGLE)], [0, np.sin(ANGLE), np.cos(ANGLE)]])


@pytest.fixture
def ground() -> Gaussians:
    """A ground whose normal is TURN @ [0, -1, 0]: two thirds are flat and lie along it."""
    model = points(np.random.default_rng(0).uniform(-1, 1, (1000, 3)) * [2, 0.02, 2] @ TURN.T, 0.01)
    flat = torch.arange(1000)[:, None] % 3 > 0
    scales = torch.where(flat, torch.tensor([0.0, -3.0, 0.0]), torch.tensor([-2.0, 0.0, 0.0]))
    quats = torch.where(flat, torch.tensor([np.cos(ANGLE / 2), np.sin(ANGLE / 2), 0.0, 0.0]), model.quats).float()
    return model.replace(log_scales=model.log_scales + scales, quats=quats)


def test_the_up_axis(show: Any, save: Any, ground: Gaussians, tmp_path: Path) -> None:
    """That of a tilted ground; that of the photographs' cameras, if any; or a chosen one, which a link keeps."""
    path = save(ground)
    shown = show(path, viewport=TALL)

    def up_of(view: dict[str, np.ndarray], tilt: float) -> np.ndarray:
        return np.asarray(-np.cos(tilt) * view["axes"][3:] - np.sin(tilt) * forward(view))

    assert up_of(link(shown), np.arctan(0.5)) @ (TURN @ [0, -1, 0]) > np.cos(np.radians(5))
    shown.page.click("#menu-open")
    assert shown.page.inner_text("#up option") == "found from the scene"
    shown.page.select_option("#up", "0,0,1")
    chosen = link(shown)
    assert chosen["up"].tolist() == [0, 0, 1] and abs(chosen["axes"][2]) < 1e-6 and forward(chosen)[2] < 0
    opened = show(path, address=shown.page.evaluate("location.hash"), viewport=TALL)
    opened.page.keyboard.press("ArrowLeft")
    assert abs(link(opened)["axes"][2]) < 1e-6
    cameras = [replace(camera, name=f"{k}.jpg") for k, camera in enumerate(scenes.ring(3, 320, 240))]
    write_model(tmp_path, cameras, [camera.name for camera in cameras])
    shown = show(path, "--images", tmp_path, viewport=TALL)
    shown.page.click("#menu-open")
    assert shown.page.inner_text("#up option") == "as in the photographs"
    shown.page.evaluate("document.activeElement.blur()")
    before = link(shown)["axes"]
    shown.page.keyboard.press("ArrowLeft")
    turned, up = link(shown)["axes"], -sum(camera.viewmat[1, :3].numpy() for camera in cameras)
    assert abs((turned - before)[:3] @ up) < 1e-4 < np.abs(turned - before).max()


# Frames whose time is hardly more than 0.
FAST = """
    const P = WebGL2RenderingContext.prototype, { getExtension } = P;
    P.getExtension = function (name) { return name.includes("timer_query") ? null : getExtension.call(this, name); };
    P.readPixels = () => {};
"""


def test_placed_cameras_are_levelled(tabs: Any, save: Any, ground: Gaussians, tmp_path: Path) -> None:
    """By the scene's up axis; steep ones are last, and the dial begins at 0. Photographs' cameras stay, at s = 1."""
    model = clod_adapter.load(save(scenes.dialled(1000, 0, 1).replace(**ground.tensors())))
    up = TURN @ [0, -1, 0]
    assert model.gaussians.attenuation is not None
    towards = torch.tensor(np.array([-up, [1, 0, 0.5]])).float()
    views = [Camera(scenes.looking(each), torch.eye(3), 4, 3) for each in towards]
    places = tuple(viewpoint_of(view, model.gaussians.means, model.gaussians.attenuation) for view in views)
    row = CalibrationRow(1.0, 9.0, 30.0, 0.9, 1.0)
    for against in ("checkpoint", "photographs"):
        measured = Calibration((row,), 1000, 1, 400, 300, "a", against, places)
        write_viewer_page(tmp_path / "page.html", replace(model, calibration=measured))
        page = tabs.new_page()
        page.add_init_script(FAST)
        shown = Shown(page).ready((tmp_path / "page.html").as_uri())
        view, placed = link(shown), against == "checkpoint"
        assert shown.text("#dial-value") == ("all" if placed else "s = 1.00")
        assert shown.page.locator("#camera option").all_inner_texts()[0] == f"viewpoint {2 if placed else 1}"
        assert (abs(view["axes"][:3] @ up) < 0.02 and view["axes"][3:] @ up < -0.5) or not placed
        assert shown.errors == []
        page.close()


@pytest.mark.parametrize("viewport", [(390, 844), (900, 420), (1280, 800)], ids=["phone", "lying phone", "desktop"])
def test_the_picture_of_a_photograph_is_not_cut(
    show: Any, save: Any, tmp_path: Path, artefacts: Path, viewport: tuple[int, int]
) -> None:
    """Red balls at its corners are within the window and not behind the panel; so is a splat without photographs."""
    camera = replace(scenes.camera(320, 240, off_centre=(0.5, 0.5)), name="0.jpg")
    corners = torch.tensor([[x, y, 1.0] for x in (13.0, 307.0) for y in (13.0, 227.0)])
    where = camera.position + (corners @ torch.linalg.inv(camera.K).T * 3) @ camera.viewmat[:3, :3]
    path = save(points(where, 0.02, [[1.5, -1.7, -1.7]] * 4))
    write_model(tmp_path, [camera], ["0.jpg"])
    width, height = viewport
    for words in ((path, "--images", tmp_path), (path,)):
        shown = show(*words, viewport={"width": width, "height": height})
        red = shown.picture()[..., 0] > 100
        box = shown.page.evaluate("document.getElementById('panel').getBoundingClientRect().toJSON()")
        red[int(box["top"]) : int(box["bottom"]), int(box["left"]) : int(box["right"])] = False
        shown.page.screenshot(path=artefacts / f"framing_{width}_{len(words)}.png")
        rows, columns = np.nonzero(red)
        middle = (rows.min() + rows.max()) / 2, (columns.min() + columns.max()) / 2
        found = {(bool(y > middle[0]), bool(x > middle[1])) for y, x in zip(rows, columns, strict=True)}
        assert len(found) == 4, words
        assert min(rows.min(), columns.min()) > 0 and rows.max() < height - 1 and columns.max() < width - 1


def test_the_path_through_the_photographs(show: Any, model: Path, tmp_path: Path) -> None:
    """Played again from its end; Space or a drag stops it."""
    cameras = [replace(camera, name=f"{k}.jpg") for k, camera in enumerate(scenes.ring(40, 320, 240)[:4])]
    write_model(tmp_path, cameras, [camera.name for camera in cameras])
    shown = show(model, "--images", tmp_path, viewport=TALL)
    shown.page.keyboard.press("Space")
    for number in (1, 2, 3, 0):
        shown.until(f"document.getElementById('camera').selectedIndex === {number}")
    assert shown.page.evaluate("document.getElementById('play').matches('.playing')")
    shown.page.keyboard.press("Space")
    assert not shown.page.evaluate("document.getElementById('play').matches('.playing')")
    still = link(shown)["eye"]
    shown.page.wait_for_timeout(200)
    assert np.array_equal(link(shown)["eye"], still)
    shown.page.click("#play")
    shown.page.wait_for_timeout(300)
    shown.page.mouse.move(500, 60)
    shown.page.mouse.wheel(0, 50)
    shown.until("!document.getElementById('play').matches('.playing')")


def test_the_turntable(shown: Shown) -> None:
    """It rotates about the pivot and the up axis until it is stopped."""
    views = [link(shown)]
    for _ in range(2):
        shown.page.keyboard.press("t")
        shown.page.wait_for_timeout(400)
        views.append(link(shown))
    shown.page.wait_for_timeout(200)
    start, turned, stopped = views
    assert np.array_equal(link(shown)["eye"], stopped["eye"])
    pivots = [view["eye"] + view["distance"] * forward(view) for view in views]
    assert np.allclose(pivots[0], pivots[2], atol=1e-4) and not np.allclose(start["eye"], turned["eye"], atol=1e-2)
    assert abs(start["eye"][1] - stopped["eye"][1]) < 1e-4


def test_pictures_and_videos_are_saved(shown: Shown) -> None:
    shown.run("clod.setDial(2)")
    picture = shown.picture()
    with shown.page.expect_download() as download:
        shown.page.keyboard.press("x")
    assert download.value.suggested_filename == "model_s2.00.png"
    saved = np.asarray(Image.open(io.BytesIO(Path(download.value.path()).read_bytes())).convert("RGB"))
    assert np.array_equal(saved, picture)
    record = "document.getElementById('record').click()"
    shown.page.evaluate(record)
    shown.page.wait_for_timeout(1500)
    assert shown.page.text_content("#record") == "Stop recording"
    with shown.page.expect_download() as download:
        shown.page.evaluate(record)
    data = Path(download.value.path()).read_bytes()
    assert len(data) > 1000 and (data[4:8] == b"ftyp" or data[:4] == b"\x1aE\xdf\xa3")
    assert shown.page.text_content("#record") == "Record video"


def test_removed_gaussians_are_shown_in_orange(shown: Shown, save: Any, artefacts: Path) -> None:
    """In their place by depth and at full opacity, among the others in grey; the count is that of the kept ones."""
    model, camera = scenes.dialled(1500, 0, 7), scenes.camera(320, 240)
    take(shown, save(model))
    shown.camera(camera)
    shown.run("clod.setDial(3)")
    counts, plain = shown.counts(), shown.picture()
    shown.page.keyboard.press("k")
    drawn = dial(model, camera, 3.0)
    colours = 0.5 + C0 * model.sh0[:, 0].numpy()
    light = np.clip(np.maximum(colours, 0) @ [0.2126, 0.7152, 0.0722], 0, 1)
    coloured = np.where(drawn.keep[:, None], 0.3 * light[:, None], ORANGE)
    wanted = model.replace(
        sigma_d=None, attenuation=None, sh0=torch.tensor((coloured - 0.5) / C0, dtype=torch.float32)[:, None],
        opacity_logits=torch.where(drawn.keep, drawn.opacities.logit(), model.opacity_logits),
    )  # fmt: skip
    assert 0.1 < drawn.keep.float().mean() < 0.9
    assert_alike(shown.picture(), render(wanted, camera).pixels.numpy(), artefacts / "removed.png")
    assert shown.counts()["kept"] == counts["kept"] == int(drawn.keep.sum())
    shown.page.keyboard.press("k")
    assert np.array_equal(shown.picture(), plain) and shown.counts() == counts


HEADSET = """
    const matrix = (x) => Float32Array.from([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, 0, 0, 1]);
    const projectionOf = (side) => Float32Array.from([1.5, 0, 0, 0, 0, 1.2, 0, 0, side, -0.1, -1, -1, 0, 0, -0.02, 0]);
    const views = [[-0.03, 0.6], [0.03, -0.6]].map(([x, side], k) => (
        { k, transform: { matrix: matrix(x) }, projectionMatrix: projectionOf(side) }
    ));
    const pose = { transform: { matrix: matrix(0) }, views };
    const session = new EventTarget();
    let next = null;
    Object.assign(session, {
        updateRenderState() {}, requestReferenceSpace: async () => ({}), requestAnimationFrame(each) { next = each; },
        inputSources: [{ handedness: "right", gamepad: { axes: [0, 0, 0, 0] } }],
    });
    window.headset = {
        session,
        frame(time, stick = 0) {
            session.inputSources[0].gamepad.axes[3] = stick;
            next(time, { getViewerPose: () => pose });
            return window.pixels ? pixels() : document.getElementById("canvas").toDataURL();
        },
    };
    const supports = async (mode) => mode === `immersive-${window.mode ?? "vr"}`;
    const xr = { isSessionSupported: supports, requestSession: async () => session };
    Object.defineProperty(navigator, "xr", { value: xr });
    WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
    window.XRWebGLLayer = class {
        constructor(session, gl) { this.framebuffer = window.targetOf?.(gl) ?? null; }
        getViewport({ k }) { return { x: 200 * k, y: 0, width: 200, height: 320 }; }
    };
"""


# Of a headset that shows what is behind the picture: the bytes of its RGBA image, in place of the canvas.
TRANSPARENT = """
    window.mode = "ar";
    window.targetOf = (gl) => {
        const texture = gl.createTexture(), framebuffer = gl.createFramebuffer();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, 400, 320);
        gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        window.pixels = () => {
            const found = new Uint8Array(4 * 400 * 320);
            gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
            gl.readPixels(0, 0, 400, 320, gl.RGBA, gl.UNSIGNED_BYTE, found);
            return "," + btoa(Array.from(found, (byte) => String.fromCharCode(byte)).join(""));
        };
        return framebuffer;
    };
"""


@pytest.mark.parametrize("script", ["", REAL_GPU, TRANSPARENT], ids=["worker", "webgpu", "transparent"])
def test_a_headset_shows_the_splat_to_each_eye(tabs: Any, artefacts: Path, save: Any, script: str) -> None:
    """A simulated one, each of whose eyes sees what the other one does not; the right stick turns the dial."""
    mode, other = ("ar", "vr") if script == TRANSPARENT else ("vr", "ar")
    model = scenes.dialled(1500, 0, 7)
    camera = scenes.camera(400, 320)
    level = torch.eye(4)
    level[:3, 3] = torch.tensor([-0.3, 0.2, 3.0])
    with serve(save(model), "--sv", 2) as url:
        page = tabs.new_page()
        page.set_viewport_size(SIZE)
        page.add_init_script(HEADSET + script)
        shown = Shown(page).ready(url)
        if script == REAL_GPU and not sorts_on_gpu(shown):
            pytest.skip("this Chromium has no WebGPU adapter")
        shown.camera(replace(camera, viewmat=level))
        scale = float(link(shown)["distance"][0]) / 1.5
        shown.until(f"!document.getElementById('immersive-{mode}').hidden")
        assert page.evaluate(f"document.getElementById('immersive-{other}').hidden")
        page.evaluate(f"document.getElementById('immersive-{mode}').click()")
        shown.until("(() => { try { headset.frame(0); return true } catch { return false } })()")
        page.wait_for_timeout(300)
        data = base64.b64decode(page.evaluate("headset.frame(1)").partition(",")[2])
        if script == TRANSPARENT:
            picture = np.frombuffer(data, np.uint8).reshape(320, 400, 4)[::-1]
        else:
            picture = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
        for k in range(2):
            K = torch.tensor([[150.0, 0, (40.0, 160.0)[k]], [0, 192.0, 144.0], [0, 0, 1]])
            viewmat = level.clone()
            viewmat[0, 3] -= (-0.03, 0.03)[k] * scale
            eye = Camera(viewmat, K, 200, 320)
            wanted, part = render(model, eye, 2.0), picture[:, 200 * k : 200 * k + 200]
            assert_alike(part[..., :3], wanted.pixels.numpy(), artefacts / f"eye{k}.png")
            if script == TRANSPARENT:
                alpha = (255 * wanted.alpha[..., None]).round().to(torch.uint8).numpy()
                assert_alike(part[..., 3:].repeat(3, 2), alpha.repeat(3, 2), artefacts / f"alpha{k}.png")
        page.evaluate("[1000, 1100, 1200].forEach((time) => headset.frame(time, 1))")
        page.evaluate("headset.session.dispatchEvent(new Event('end'))")
        shown.until("document.getElementById('dial-value').textContent !== 's = 2.00'")
        assert shown.page.inner_text("#dial-value") == f"s = {2 * 2**0.3:.2f}" and shown.errors == []
        page.close()


def test_without_a_headset_there_is_no_button(shown: Shown) -> None:
    shown.page.evaluate("document.getElementById('menu').hidden || document.getElementById('menu-open').click()")
    assert shown.page.is_hidden("#immersive-vr") and shown.page.is_hidden("#immersive-ar")
