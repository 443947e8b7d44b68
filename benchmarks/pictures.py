"""The pictures of the dial and the viewer for README and docs, of the demo's scene.

    clod-adapt demo                  # makes demo/base.ply, demo/gallery.ply and demo/capture
    python benchmarks/pictures.py    # dial.webp and viewer.webp in docs/images

The dial's picture has numbers of the view shown, measured then. The other is of a headless
Chromium.
"""

import io
import sys
import tempfile
from pathlib import Path

import clod_adapter as clod
from clod_adapter.demo import TITLE, VIEW, compared, dial_strip, merging
from clod_adapter.io.atomic import atomic_path
from common import ROOT, arguments

from PIL import Image

sys.path.insert(0, str(ROOT / "tests"))
import browser  # noqa: E402
from shown import Shown, serve  # noqa: E402

IMAGES = ROOT / "docs" / "images"
SIZE = {"width": 1280, "height": 800}
DIAL = 3.0


def main():
    parser = arguments(__doc__)
    parser.add_argument(
        "demo", nargs="?", default="demo", help="the folder of clod-adapt demo (default: demo)"
    )
    folder = Path(parser.parse_args().demo)
    keep(IMAGES / "dial.webp", dial(folder))
    with browser.launch() as chromium:
        keep(IMAGES / "viewer.webp", viewer(chromium, folder))


def dial(folder):
    """The strip of the demo."""
    base, model = (clod.load(folder / name).gaussians for name in ("base.ply", "gallery.ply"))
    scene = clod.load_scene(folder / "capture")
    panels = compared(base, model, scene.test[VIEW], merging(base, scene))
    with tempfile.TemporaryDirectory() as made:
        file = Path(made) / "dial.png"
        dial_strip(file, panels, TITLE)
        return file.read_bytes()


def viewer(chromium, folder):
    """The page in dark."""
    capture = folder / "capture"
    camera = clod.load_scene(capture).test[VIEW].camera
    words = [folder / "gallery.ply", "--base", folder / "base.ply", "--images", capture]
    words += ["--sv", DIAL]
    with serve(*words) as url, chromium.new_context(viewport=SIZE, color_scheme="dark") as context:
        shown = Shown(context.new_page()).ready(url)
        cameras = shown.run(
            "JSON.parse(document.getElementById('clod-config').textContent).cameras.map((c) =>"
            " c.name)"
        )
        # as a user goes to it, so that the view fills the window
        for _ in range(cameras.index(camera.name)):
            shown.page.keyboard.press("n")
        shown.run("clod.setWipe(0.55)")
        shown.page.evaluate("document.getElementById('frame').style.visibility = 'hidden'")
        shown.page.wait_for_timeout(250)  # longer than the page draws fewer pixels after a movement
        shown.run("clod.whenDrawn()")
        return bytes(shown.page.screenshot(timeout=120_000))


def keep(path, picture):
    """Writes a screenshot as WebP."""
    with atomic_path(path) as temporary:
        Image.open(io.BytesIO(picture)).convert("RGB").save(temporary, "WEBP", quality=80, method=6)
    print(f"wrote {path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
