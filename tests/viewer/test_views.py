"""Keys, pointer, touch, typed counts, links and lists; orbit centre, up axis, framing, animations,
pictures, videos.
"""

import io
import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

import clod_adapter
import scenes
from clod_adapter.cameras import Camera
from clod_adapter.equation.distances import camera_of, viewpoint_of
from clod_adapter.io.file_formats import write
from clod_adapter.quality_table import QualityRow, QualityTable
from clod_adapter.render import render
from clod_adapter.viewer.page import up_axis, write_viewer_page
from models import write_model
from scenes import ring
from shown import TALL, decoded, drop, fold, take


def differ(one, other):
    return bool(np.abs(one.astype(int) - other).mean() > 0.3)


def photographed(folder, cameras):
    """Cameras with names, written to a folder as those of photographs."""
    named = [replace(camera, name=f"{k}.jpg") for k, camera in enumerate(cameras)]
    write_model(folder, named, [camera.name for camera in named])
    return named


def test_keys_move_the_dial(shown):
    full = shown.counts()["kept"]
    assert shown.dial == "s = 1.00"
    for _ in range(10):
        shown.press("]")
    fewer = shown.counts()["kept"]
    shown.press("[")
    assert fewer < shown.counts()["kept"] < full
    shown.page.focus("#dial")
    shown.press("End")
    assert shown.dial == "s = 5.00" and shown.counts()["kept"] < fewer
    shown.press("Home")
    assert shown.dial == "all" and shown.counts()["kept"] == 400 > full
    shown.run("clod.setDial(2)")
    shown.press("e")
    assert shown.counts()["kept"] == 400 and not shown.page.is_checked("#equation")
    assert shown.dial == "off"
    shown.press("e")
    assert shown.dial == "s = 2.00"


def target(shown, text):
    """The page's note after a count is entered."""
    shown.page.fill("#target", text)
    shown.evaluate("document.getElementById('target-note').textContent = ''")
    shown.press("Enter")
    shown.until("document.getElementById('target-note').textContent !== ''")
    shown.counts()  # once drawn: Enter asks twice, by its key and by the change of the text
    return shown.text("#target-note")


def test_the_count_box(shown, gaussians):
    """A count sets the dial value of ``dial_for``; its note ends with the state that it is about.
    Keys wait.
    """
    camera = scenes.camera(320, 240)
    wanted = clod_adapter.dial_for(gaussians, keep=280, cameras=[camera]).virtual_scale
    fold(shown, True)
    shown.camera(camera)
    before = shown.picture()
    shown.page.focus("#target")
    shown.page.keyboard.type("wasdech0")
    assert shown.page.input_value("#target") == "wasdech0"
    assert np.array_equal(shown.picture(), before)
    for text in ("0", "1.5", "0.0015k", "k", "20%%", "many"):
        assert "Enter a number of Gaussians" in target(shown, text)
        assert shown.dial == "s = 1.00"
    assert "keeps" in target(shown, "1,000,000")
    shown.run("clod.setEquation(false)")
    assert "keeps 280 in this view" in target(shown, "280")
    assert shown.counts()["kept"] == 280 and shown.page.is_checked("#equation")
    assert float(shown.dial.removeprefix("s = ")) == pytest.approx(wanted, rel=0.02)
    for text, count in (("0.28k", 280), ("70 %", 280), ("0.00028M", 280)):
        assert f"keeps {count} in this view" in target(shown, text), text
    for change in ("]", "ArrowLeft"):
        assert "keeps" in target(shown, "280")
        shown.evaluate("document.activeElement.blur()")
        shown.press(change)
        assert shown.text("#target-note") == shown.page.input_value("#target") == "", change


def test_narrow_phones(show, model):
    """The help opens at its start, and lists show their text."""
    shown = show(model, viewport={"width": 320, "height": 480})
    shown.page.click("#fold")
    width = "document.getElementById('rate').clientWidth"
    assert shown.evaluate(width) > 60
    shown.page.click("#help-open")
    assert shown.evaluate("document.getElementById('help').scrollTop") == 0
    shown.page.keyboard.press("Tab")
    assert shown.evaluate("document.activeElement.textContent") == "Close"


def test_pointer_touch_and_wheel_move_the_camera(chromium, show, model):
    shown = show(model, context=chromium.new_context(has_touch=True))
    protocol = shown.page.context.new_cdp_session(shown.page)
    mouse = shown.page.mouse

    def drag():
        mouse.move(100, 60)
        mouse.down()
        mouse.move(150, 80, steps=3)
        mouse.up()

    def touch(*moves):
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
    shown.press("0")
    assert np.array_equal(shown.picture(), fitted)


def test_files_and_cameras_are_listed(show, gaussians, tmp_path):
    """Switched by keys, lists and a link: view and base stay, and the dial value where the file has
    it.
    """
    second = gaussians.replace(
        sh0=-gaussians.sh0, attenuation=replace(gaussians.attenuation, max_sv=2.0)
    )
    models = {"a.ply": gaussians, "b.pt": second, "c.ply": scenes.attenuated(9, 1, 5)}
    for name, model in models.items():
        write(tmp_path / name, model)
    photographed(tmp_path, ring(3, 320, 240))
    files = [tmp_path / name for name in models]
    words = [*files, "--base", files[0], "--images", tmp_path, "--sv", 3]
    shown = show(*words, viewport=TALL)
    assert shown.page.locator("#files option").all_inner_texts() == list(models)
    links = {"0.jpg": shown.link()}
    for key, name in (("n", "1.jpg"), ("n", "2.jpg"), ("n", "0.jpg"), ("p", "2.jpg")):
        shown.press(key)
        assert shown.page.input_value("#camera") == name
        assert links.setdefault(name, shown.link()) == shown.link()
    assert len({*links.values()}) == 3
    shown.page.select_option("#camera", "1.jpg")
    assert shown.link() == links["1.jpg"]
    shown.evaluate("document.activeElement.blur()")
    shown.press("ArrowRight")
    assert shown.page.input_value("#camera") == "free view"
    shown.press("2")
    shown.until("document.title === 'b.pt'")
    assert shown.dial == "s = 2.00"
    shown.run("clod.setWipe(0.4)")
    assert shown.text("#wipe-right") == "base · 400"
    linked = shown.link()
    of_second = shown.picture()
    shown.run("clod.setWipe(null)")
    drop(shown, "dropped.ply", (tmp_path / "c.ply").read_bytes())
    shown.until("document.title === 'dropped.ply'")
    assert shown.text("#title") == "dropped.ply" and shown.page.input_value("#files") == ""
    assert shown.counts()["total"] == 9 and shown.dial == "s = 3.00"
    shown.press("1")
    shown.until("document.title === 'a.ply'")
    assert shown.text("#compare-with") == "Compare with the base"
    opened = show(*words, state=linked, viewport=TALL)
    assert opened.page.title() == "b.pt" and not differ(opened.picture(), of_second)


def test_a_page_of_two_files(show, gaussians, tmp_path):
    """Switched there and back, and back from a dropped file, though the page frees its data."""
    for name, model in {"a.ply": gaussians, "b.ply": gaussians[:200]}.items():
        write(tmp_path / name, model)
    first, second = (clod_adapter.load(tmp_path / name) for name in ("a.ply", "b.ply"))
    out = tmp_path / "page.html"
    write_viewer_page(out, first, others=[second], cameras=ring(1, 320, 240), virtual_scale=2.0)
    shown = show(url=out.as_uri(), viewport=TALL)
    assert shown.page.locator("#files option").all_inner_texts() == ["a.ply", "b.ply"]
    picture = shown.picture()
    for key, name, total in (("2", "b.ply", 200), ("1", "a.ply", 400), ("2", "b.ply", 200)):
        shown.press(key)
        shown.until(f"document.title === '{name}'")
        assert shown.counts()["total"] == total and shown.dial == "s = 2.00"
        assert differ(shown.picture(), picture) == (name == "b.ply")
    drop(shown, "dropped.ply", (tmp_path / "a.ply").read_bytes())
    shown.until("document.title === 'dropped.ply'")
    shown.press("1")
    shown.until("document.title === 'a.ply'")


def test_another_scene_opens_in_its_own_view(show, gaussians, tmp_path):
    """A level of the same scene in the view that is there."""
    other = gaussians.replace(
        means=5 * gaussians.means + 40,
        log_scales=gaussians.log_scales + np.log(5),
        sigma_d=5 * gaussians.sigma_d,
    )
    models = {"a.ply": gaussians, "b.ply": gaussians[:200], "c.ply": other}
    for name, model in models.items():
        write(tmp_path / name, model)
    photographed(tmp_path, ring(3, 320, 240))
    shown = show(*(tmp_path / name for name in models), "--images", tmp_path)
    shown.press("n")
    second = link(shown)["eye"]
    for key, name, cameras in (("2", "b.ply", 3), ("3", "c.ply", 0), ("1", "a.ply", 3)):
        shown.press(key)
        shown.until(f"document.title === '{name}'")
        shown.run("clod.whenDrawn()")
        assert shown.page.locator("#camera option").count() == cameras + 1
        assert shown.picture().max() > 50
        assert np.array_equal(link(shown)["eye"], second) == (name == "b.ply")


def link(shown):
    pairs = (part.split("=") for part in shown.link().lstrip("#").split("&"))
    return {name: np.array(text.split(","), float) for name, text in pairs}


def forward(view):
    return np.cross(view["axes"][:3], view["axes"][3:])


def points(means, size, sh0=None):
    """Opaque balls."""
    means = torch.as_tensor(means, dtype=torch.float32)
    model = scenes.gaussians(len(means), 0, 1)
    opaque = torch.full((len(means),), 6.0)
    return model.replace(
        means=means,
        log_scales=torch.full_like(means, float(np.log(size))),
        opacity_logits=opaque,
        sh0=model.sh0 if sh0 is None else torch.as_tensor(sh0, dtype=torch.float32)[:, None],
    )


def ground(angle):
    """A ground, of which two thirds are flat and lie along it, turned about x by an angle from
    minus y; its normal.
    """
    turn = np.array(
        [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    )
    model = points(np.random.default_rng(0).uniform(-1, 1, (1000, 3)) * [2, 0.02, 2] @ turn.T, 0.01)
    flat = torch.arange(1000)[:, None] % 3 > 0
    scales = torch.where(flat, torch.tensor([0.0, -3.0, 0.0]), torch.tensor([-2.0, 0.0, 0.0]))
    quats = torch.where(
        flat, torch.tensor([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]), model.quats
    ).float()
    return model.replace(log_scales=model.log_scales + scales, quats=quats), turn @ [0, -1, 0]


def test_the_up_axis(shown, show, save, tmp_path):
    """That of a tilted ground; that of the photographs' cameras, if any; or a chosen one, which a
    link keeps.
    """

    def up_of(view, tilt):
        return np.asarray(-np.cos(tilt) * view["axes"][3:] - np.sin(tilt) * forward(view))

    for angle in np.radians([-80, 25]):  # z up, and y down
        model, normal = ground(angle)
        take(shown, path := save(model))
        assert up_of(link(shown), np.arctan(0.5)) @ normal > np.cos(np.radians(5))
        assert up_axis(model) @ normal > np.cos(np.radians(5))  # of a poster
    assert shown.page.text_content("#up option") == "found from the scene"
    shown.page.eval_on_selector(
        "#up", "(up) => { up.value = '0,0,1'; up.dispatchEvent(new Event('change')); }"
    )
    chosen = link(shown)
    assert chosen["up"].tolist() == [0, 0, 1]
    assert abs(chosen["axes"][2]) < 1e-6
    assert forward(chosen)[2] < 0
    cameras = photographed(tmp_path, ring(3, 320, 240))
    with_cameras = show(path, "--images", tmp_path)
    assert with_cameras.page.text_content("#up option") == "as in the photographs"
    before = link(with_cameras)["axes"]
    with_cameras.press("ArrowLeft")
    turned = link(with_cameras)["axes"]
    up = -sum(camera.viewmat[1, :3].numpy() for camera in cameras)
    assert abs((turned - before)[:3] @ up) < 1e-4 < np.abs(turned - before).max()
    with_cameras.evaluate("hash => { location.hash = hash }", shown.evaluate("location.hash"))
    with_cameras.until("document.getElementById('up').value === '0,0,1'")
    with_cameras.press("ArrowLeft")
    assert abs(link(with_cameras)["axes"][2]) < 1e-6


@pytest.mark.parametrize(
    "lines, up",
    [
        ("comment Vertical Axis: z", [0, 0, 1]),  # nerfstudio
        ("comment Vertical axis: y", [0, -1, 0]),  # Brush, before it knew others
        ("comment Vertical axis: 0.6 0 -0.8\ncomment Vertical axis: 0 0 0", [0.6, 0, -0.8]),
        ("comment vertical axis: [3e1, -40, 0.]", [0.6, -0.8, 0]),
        ("comment Vertical axis: 1 2", None),
    ],
)
def test_the_up_axis_that_a_file_states(shown, show, save, tmp_path, lines, up):
    """Of a file that is opened, of the page's own, and of a poster."""
    model, normal = ground(np.radians(25))
    path = save(model.replace(sigma_d=None, growth_d=None, attenuation=None))
    header, _, rows = path.read_bytes().partition(b"end_header")
    path.write_bytes(header + lines.encode() + b"\nend_header" + rows)
    says = "found from the scene" if up is None else "as the file states"
    up = np.array(normal if up is None else up, float)
    within = np.cos(np.radians(5 if says.startswith("found") else 0.01))
    saved = clod_adapter.load(path)
    assert up_axis(saved.gaussians, saved.comments) @ up > within
    take(shown, path)
    opened = [shown]
    for exact in (True, False):
        write_viewer_page(tmp_path / "page.html", saved, exact=exact)
        opened.append(show(url=(tmp_path / "page.html").as_uri()))
    for each in opened:
        assert each.page.text_content("#up option") == says
        view = link(each)
        pitch = np.arctan(0.5)
        assert (-np.cos(pitch) * view["axes"][3:] - np.sin(pitch) * forward(view)) @ up > within


def test_placed_cameras_are_levelled(show, model, tmp_path):
    saved = clod_adapter.load(model)
    viewmat = scenes.looking(torch.tensor([1.0, 0.5, 0.5]))
    tilted = Camera(
        viewmat[[1, 0, 2, 3]] * torch.tensor([[-1.0], [1], [1], [1]]), torch.eye(3), 4, 3
    )
    place = viewpoint_of(tilted, saved.gaussians.means, saved.gaussians.attenuation)
    measured = QualityTable(
        (QualityRow(1.0, 9.0, 30.0, 0.9, 1.0),), 400, 1, 400, 300, "a", "checkpoint", (place,)
    )
    write_viewer_page(tmp_path / "page.html", replace(saved, quality_table=measured))
    poster = re.findall('jpeg;base64,([^"]*)', (tmp_path / "page.html").read_text("utf-8"))
    level = replace(camera_of(place, 400, 300, ""), viewmat=viewmat)
    wanted = render(saved.gaussians, level, 0.0).pixels.numpy()
    assert peak_signal_noise_ratio(wanted, decoded(poster[0])) > 30
    # frames whose time is hardly more than 0
    fast = "WebGL2RenderingContext.prototype.readPixels = () => {}"
    shown = show(url=(tmp_path / "page.html").as_uri(), script=fast)
    assert shown.dial == "all"
    assert np.allclose(link(shown)["axes"][:3], viewmat[0, :3], atol=1e-4)
    shown.run("clod.setDial(1)")
    assert shown.text("#quality") == "30.0 dB to the checkpoint"


@pytest.mark.parametrize("photographs", [True, False])
def test_the_picture_and_the_panel_fit_the_window(show, save, tmp_path, photographs):
    """On a phone, also lying, and a desktop: red balls at the picture's corners are not behind the
    panel.
    """
    camera = scenes.camera(320, 240, off_centre=(0.5, 0.5))
    corners = torch.tensor([[x, y, 1.0] for x, y in product((13.0, 307.0), (13.0, 227.0))])
    where = camera.position + (corners @ torch.linalg.inv(camera.K).T * 3) @ camera.viewmat[:3, :3]
    path = save(points(where, 0.02, [[1.5, -1.7, -1.7]] * 4))
    photographed(tmp_path, [camera])
    words = ("--images", tmp_path) if photographs else ()
    shown = show(path, *words, viewport={"width": 390, "height": 844})
    for width, height in ((390, 844), (900, 420), (1280, 800)):
        shown.page.set_viewport_size({"width": width, "height": height})
        shown.until(f"document.getElementById('canvas').clientWidth === {width}")
        shown.page.wait_for_timeout(50)
        if width == 1280:
            shown.page.click("#fold")
        shown.press("0")
        red = shown.picture()[..., 0] > 100
        panel = "document.getElementById('panel').getBoundingClientRect().toJSON()"
        box = shown.evaluate(panel)
        assert box["left"] >= 0 and box["right"] <= width
        assert box["top"] >= 0 and box["bottom"] <= height
        red[int(box["top"]) : int(box["bottom"]), int(box["left"]) : int(box["right"])] = False
        places = np.argwhere(red)
        first = places.min(0)
        last = places.max(0)
        corners = places > (first + last) / 2
        assert len(np.unique(corners, axis=0)) == 4, width
        assert first.min() > 0 and (last < np.array([height, width]) - 1).all()


SELECTED = """() => {
    window.selected = [];
    const look = () => {
        const { selectedIndex } = document.getElementById("camera");
        if (selectedIndex !== window.selected.at(-1)) window.selected.push(selectedIndex);
        requestAnimationFrame(look);
    };
    look();
}"""


def test_the_path_and_the_turntable(show, model, tmp_path):
    """The path begins again at its end; Space or a drag stops it. The turntable rotates about the
    pivot and up axis.
    """
    cameras = [replace(camera, name=f"{k}.jpg") for k, camera in enumerate(ring(80, 320, 240)[:3])]
    write_model(tmp_path, cameras, [camera.name for camera in cameras])
    shown = show(model, "--images", tmp_path)
    playing = "document.querySelector('#play.playing')"
    views = [link(shown)]
    for _ in range(2):
        shown.press("t")
        shown.page.wait_for_timeout(300)
        views.append(link(shown))
    start, turned, stopped = views
    assert np.array_equal(link(shown)["eye"], stopped["eye"])
    pivots = [view["eye"] + view["distance"] * forward(view) for view in views]
    assert np.allclose(pivots[0], pivots[2], atol=1e-4)
    assert not np.allclose(start["eye"], turned["eye"], atol=1e-2)
    shown.press("0")
    shown.press("Space")
    shown.evaluate(SELECTED)  # in each frame: the last camera is there for one
    shown.until("window.selected.join().includes('1,2,0')")
    assert shown.evaluate(f"{playing} !== null")
    shown.press("Space")
    assert shown.evaluate(f"{playing} === null")
    still = link(shown)["eye"]
    shown.page.wait_for_timeout(200)
    assert np.array_equal(link(shown)["eye"], still)
    shown.press("Space")
    shown.page.mouse.move(300, 60)
    shown.page.mouse.wheel(0, 50)
    shown.until(f"{playing} === null")


def test_pictures_and_videos_are_saved(shown):
    shown.run("clod.setDial(2)")
    picture = shown.picture()
    with shown.page.expect_download() as download:
        shown.press("x")
    assert download.value.suggested_filename == "model_s2.00.png"
    saved = np.asarray(
        Image.open(io.BytesIO(Path(download.value.path()).read_bytes())).convert("RGB")
    )
    assert np.array_equal(saved, picture)
    record = "document.getElementById('record').click()"
    shown.evaluate(record)
    shown.page.wait_for_timeout(1000)  # an encoder on a busy machine has no picture sooner
    assert shown.page.text_content("#record") == "Stop recording"
    with shown.page.expect_download() as download:
        shown.evaluate(record)
    data = Path(download.value.path()).read_bytes()
    assert len(data) > 1000 and (data[4:8] == b"ftyp" or data[:4] == b"\x1aE\xdf\xa3")
    assert shown.page.text_content("#record") == "Record video"
