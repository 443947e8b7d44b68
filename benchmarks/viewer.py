"""The page in a headless Chromium against clod_adapter.render: pictures and counts.

Each capture's checkpoint is first adapted for 100 steps (kept in ``benchmarks/cache``). At some
held-out cameras and dial values, and with the equation off: PSNR between the browser's picture and
``clod_adapter.render``, and the counts. Each capture adds a row to ``results/viewer.jsonl``.
"""

import sys

import clod_adapter as clod
from common import CACHE, ROOT, append, arguments, capture, clod_adapt

import numpy as np
import torch

sys.path.insert(0, str(ROOT / "tests"))
import browser  # noqa: E402
from shown import Shown, serve  # noqa: E402

FILE = "viewer.jsonl"
CAPTURES = ("plush_half", "bonsai146")
DIALS = (1.0, 3.0, 5.0)
CAMERAS = 4


def main():
    parser = arguments(__doc__)
    parser.add_argument("captures", nargs="*", default=CAPTURES)
    with browser.launch() as chromium:
        for name in parser.parse_args().captures:
            append(FILE, measure(chromium, name))


def measure(chromium, name):
    """Pictures and counts at held-out cameras."""
    path = adapted(name)
    model = clod.load(path)
    views = clod.load_scene(capture(name), origin=model.origin).test
    cameras = [view.camera for view in views[:: max(len(views) // CAMERAS, 1)][:CAMERAS]]
    size = {"width": cameras[0].width, "height": cameras[0].height}
    with serve(path) as url, chromium.new_context(viewport=size) as context:
        context.set_default_timeout(300_000)
        shown = Shown(context.new_page()).ready(url)
        rows = []
        for camera in cameras:
            rows += compare(shown, model.gaussians, camera)
        return {
            "capture": name,
            "gaussians": len(model.gaussians),
            "sh_degree": model.gaussians.sh_degree,
            "picture": size,
            "chromium": chromium.version,
            "rows": rows,
            "errors": shown.errors,
        }


def compare(shown, gaussians, camera):
    """A camera at each dial value, and with the equation off (dial None)."""
    shown.camera(camera)
    rows = []
    for dial in (*DIALS, None):
        shown.run(f"clod.setEquation({str(dial is not None).lower()})")
        shown.run("clod.setDial(given)", dial or 1.0)
        drawn = gaussians if dial else clod.detach(gaussians)
        with torch.no_grad():
            wanted = clod.render(drawn, camera, dial or 1.0)
        error = float(((shown.picture().astype(np.float64) - wanted.pixels.numpy()) ** 2).mean())
        rows.append(
            {
                "camera": camera.name,
                "virtual_scale": dial,
                "psnr": 10 * float(np.log10(255**2 / max(error, 1e-9))),
                "kept": int(wanted.kept.sum()),
                "kept_in_page": shown.counts()["kept"],
            }
        )
    return rows


def adapted(name):
    """The capture's checkpoint with a dial."""
    path = CACHE / f"viewer-{name}.ply"
    if not path.exists():
        CACHE.mkdir(exist_ok=True)
        folder = capture(name)
        settings = ("--max-sv", 5, "--iters", 100)
        clod_adapt(folder / "pretrained.ply", "--images", folder, *settings, "-o", path)
    return path


if __name__ == "__main__":
    main()
