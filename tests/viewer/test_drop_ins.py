"""The dial in Spark and PlayCanvas: the pages of viewers/examples in a browser, with the engines from npm."""

from __future__ import annotations

import functools
import io
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import clod_adapter
import scenes
from clod_adapter.cameras import Camera
from clod_adapter.render import render

ROOT = Path(__file__).parents[2]
SIZE = {"width": 320, "height": 240}
# Cameras of these viewers look along -z with y up, and the pages turn the splat half a turn about x.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
PLACE = {
    "spark": """([m, fov]) => {
        controls.enabled = false;
        controls.update = () => {};
        camera.matrix.fromArray(m).decompose(camera.position, camera.quaternion, camera.scale);
        camera.fov = fov;
        camera.updateProjectionMatrix();
    }""",
    "playcanvas": """([m, fov]) => {
        const matrix = new pc.Mat4();
        matrix.set(m);
        camera.setPosition(matrix.getTranslation());
        camera.setRotation(new pc.Quat().setFromMat4(matrix));
        camera.camera.fov = fov;
    }""",
}


class Files(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Says nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Files, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()


def engines() -> Path:
    """The folder that npm installed the viewers into, beside splat-transform."""
    tool = shutil.which("splat-transform")
    modules = Path(tool).parents[1] if tool else Path()
    if not (modules / "@sparkjsdev" / "spark").is_dir() or not (modules / "playcanvas").is_dir():
        pytest.skip("Spark and PlayCanvas are not installed: make peers")
    return modules


@contextmanager
def opened(tabs: Any, folder: Path, viewer: str, file: str) -> Iterator[Any]:
    """The example page of a viewer; ``folder`` has ``viewers/`` and the file."""
    modules = engines()

    def of_npm(route: Any) -> None:
        name = re.sub(r"@\d[\d.]*", "", route.request.url.split("/npm/")[1])
        route.fulfill(body=(modules / name).read_bytes(), content_type="text/javascript")

    page = tabs.new_page()
    page.set_viewport_size(SIZE)
    page.route("https://cdn.jsdelivr.net/npm/**", of_npm)
    with served(folder) as url:
        page.goto(f"{url}/viewers/examples/{viewer}.html?file={url}/{file}")
        yield page
    page.close()


def place(page: Any, viewer: str, camera: Camera) -> None:
    to_world = FLIP @ torch.linalg.inv(camera.viewmat.double()).numpy() @ FLIP
    fov = 2 * np.degrees(np.arctan(camera.height / 2 / float(camera.K[1, 1])))
    page.evaluate(PLACE[viewer], [to_world.T.ravel().tolist(), fov])


def settled(page: Any) -> np.ndarray:
    """The picture, once it has stopped changing: both viewers sort in a worker."""
    before = None
    for _ in range(60):
        page.wait_for_timeout(250)
        picture = np.asarray(Image.open(io.BytesIO(page.screenshot()), formats=["PNG"]).convert("RGB"))
        if before is not None and np.array_equal(picture, before):
            break
        before = picture
    return picture


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "viewers", tmp_path / "viewers")
    return tmp_path


@pytest.mark.filterwarnings("ignore:.*adapted.spz")
@pytest.mark.parametrize(("viewer", "suffix"), [("spark", "ply"), ("spark", "spz"), ("playcanvas", "ply")])
def test_the_dial_is_as_exact_as_the_viewer(tabs: Any, folder: Path, viewer: str, suffix: str) -> None:
    gaussians, (camera,) = scenes.dialled(1500, 1, 7, reference_distance=3.0), scenes.ring(1, *SIZE.values())
    gaussians = gaussians.replace(growth_d=torch.linspace(0, 0.3, 1500))
    file = folder / f"adapted.{suffix}"
    clod_adapter.save(file, gaussians)
    read = clod_adapter.load(file).gaussians
    with opened(tabs, folder, viewer, file.name) as page:
        page.wait_for_function("window.dial", timeout=60_000)
        page.evaluate("document.forms[0].hidden = true")
        place(page, viewer, camera)
        undialled = 0.0
        for s in (0.0, 1.0, 3.0, 5.0):
            page.evaluate("(s) => dial.set(s)", s)
            wanted = render(read, camera, s)
            kept = int(wanted.kept.sum())
            assert s == 0 or page.evaluate("dial.kept") == kept
            error = settled(page) / 255 - wanted.image.clamp(0, 1).numpy()
            psnr = -10 * np.log10(np.square(error).mean())
            undialled = undialled or psnr
            assert psnr > max(undialled - 1, 25), (s, psnr, undialled)
            if viewer == "spark":  # drops opacities below its 8 bits
                assert page.evaluate("spark.activeSplats") == pytest.approx(kept, rel=0.05)
        page.evaluate("dial.set({ keep: 600 })")
        assert page.evaluate("dial.kept") == 600
        page.evaluate("dial.hold(2000)")  # out of reach
        page.wait_for_function("dial.s === dial.file.settings.max_sv", timeout=60_000)
        page.evaluate("dial.set(2)")
        page.wait_for_timeout(500)
        assert page.evaluate("dial.s") == 2


@pytest.mark.parametrize("viewer", ["spark", "playcanvas"])
def test_a_file_without_a_dial_says_so(tabs: Any, folder: Path, viewer: str) -> None:
    clod_adapter.save(folder / "plain.ply", scenes.gaussians(50, 0, 7))
    with opened(tabs, folder, viewer, "plain.ply") as page, page.expect_event("pageerror", timeout=60_000) as error:
        pass
    assert "the file has no sigma_d, so no dial; adapt it with clod-adapt" in str(error.value)
