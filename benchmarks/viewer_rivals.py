"""The page against SuperSplat's viewer: the same files, canvas and cameras in a headless Chromium.

    clod-adapt plush_half/pretrained.ply --images plush_half --max-sv 7 -o plush7.ply
    python benchmarks/viewer_rivals.py --record --file plush7.ply

The camera turns in a street of the synthetic town (``city.py``), and round plush_half, where an adapted file of it is
given (``--file``). A frame's time is the mean interval between drawn frames over a turn, after a warm-up, and
the CPU time of the browser's processes for each; the latter depends less on what else the machine does. The first
picture ends two frames after the page says that it is complete. SuperSplat's viewer knows no dial: it draws all
Gaussians. npm installs it into a temporary folder, at a fixed version. It draws with WebGL, as its WebGPU loses the
software device. All is software (SwiftShader), so the times say nothing about a GPU. ``--record`` adds rows to
``results/viewer_rivals.jsonl`` and fills in the table of docs/viewing.md.
"""

from __future__ import annotations

import functools
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple

import clod_adapter as clod
from city import city, city_cameras, look_at
from clod_adapter.equation.extinction import sigma_for_extinction
from common import ROOT, Row, append, arguments, fill_in, photographs, stored, table

import numpy as np
import torch

sys.path.insert(0, str(ROOT / "tests"))
import browser  # noqa: E402
from clod_adapter.viewer.payload import page_config  # noqa: E402
from shown import REAL_GPU, Shown, serve, sorts_on_gpu  # noqa: E402

FILE, PAGE = "viewer_rivals.jsonl", ROOT / "docs" / "viewing.md"
PACKAGE = "@playcanvas/supersplat-viewer@1.36.2"
SIZE = {"width": 640, "height": 400}
STATES = {"dial off": 0.0, "s = 1": 1.0, "s = 3": 3.0, "s = 7": 7.0}
MEASURES = {"CPU": "cpu_ms", "wall": "ms"}  # of a row
EFFECTS = ("sharpness", "bloom", "grading", "vignette", "fringing")  # of SuperSplat's viewer
STEPS, TURN, FOV = 72, 8.0, 65.0  # cameras of a circle; seconds of a turn; degrees across the width
WARM, SECONDS = 2.0, TURN  # before and while frames are counted

# Notes the time of each animation frame in which a picture was drawn.
COUNT = """
    window.drawnAt = [];
    let drawn = false;
    const { drawElementsInstanced } = WebGL2RenderingContext.prototype;
    WebGL2RenderingContext.prototype.drawElementsInstanced = function (...all) {
        drawn = true;
        return drawElementsInstanced.apply(this, all);
    };
    const tick = (now) => { if (drawn) drawnAt.push(now); drawn = false; requestAnimationFrame(tick); };
    requestAnimationFrame(tick);
    const next = () => new Promise(requestAnimationFrame);
    const shown = () => next().then(next).then(() => performance.now());
    window.complete = new Promise((done) => { window.firstFrame = () => shown().then(done); });
"""
TURNING = """(cameras) => {
    const began = performance.now();
    const step = (now) => {
        clod.setCamera(cameras[Math.floor((now - began) / 1000 / %s * cameras.length) %% cameras.length]);
        requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
}"""


class Course(NamedTuple):
    """A file, and the circle of cameras: eyes and targets ``[STEPS, 3]``."""

    name: str
    path: Path
    eyes: np.ndarray
    targets: np.ndarray

    def cameras(self) -> list[clod.Camera]:
        poses = zip(self.eyes, self.targets, strict=True)
        return [look_at(eye, target, *SIZE.values(), f"{k}") for k, (eye, target) in enumerate(poses)]


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("counts", nargs="*", type=int, default=(100_000, 500_000), help="Gaussians of the towns")
    parser.add_argument("--file", type=Path, help="an adapted file of plush_half")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, browser.launch() as chromium:
        rival = install(Path(folder))
        for course in courses(Path(folder), options.counts, options.file):
            row = measure(chromium, course, rival)
            print(json.dumps(row))
            if options.record:
                append(FILE, row)
    if options.record:
        fill_in(PAGE, "rivals", summary())


def install(folder: Path) -> Path:
    """The folder of SuperSplat's page, fetched by npm; exits without it."""
    if not shutil.which("npm"):
        sys.exit(f"npm is not on the PATH; it fetches {PACKAGE}")
    npm = ["npm", "install", "--prefix", str(folder), "--no-audit", "--no-fund", "--no-save", PACKAGE]
    ran = subprocess.run(npm, capture_output=True, text=True)
    if ran.returncode:
        sys.exit(f"npm cannot fetch {PACKAGE}: {ran.stderr.strip().splitlines()[-1]}")
    return folder / "node_modules" / "@playcanvas" / "supersplat-viewer" / "public"


def courses(folder: Path, counts: list[int], capture: Path | None) -> Iterator[Course]:
    turn = 2 * np.pi * np.arange(STEPS) / STEPS
    for count in counts:
        path, (camera,) = folder / f"town{count}.ply", city_cameras(1, 8, 8, where="near", count=count)
        clod.save(path, with_dial(city(count), camera))
        eye = camera.position.double().numpy()
        ahead = np.stack([np.sin(turn), 0 * turn, np.cos(turn)], 1)
        yield Course(f"town of {count:,}, street", path, eye + 0 * ahead, eye + ahead)
    if capture:
        views = [view.camera for view in photographs("plush_half").train]
        eyes, axes = map(np.array, zip(*map(placed, views), strict=True))
        centre, (_, spread, sides) = eyes.mean(0), np.linalg.svd(eyes - eyes.mean(0), full_matrices=False)
        far = math.sqrt(2 / len(eyes)) * spread[:2, None]
        round_ = centre + np.stack([np.sin(turn), np.cos(turn)], 1) @ (far * sides[:2])
        across = np.eye(3) - axes[:, :, None] * axes[:, None]
        nearest = np.linalg.solve(across.sum(0), (across @ eyes[:, :, None]).sum(0))[:, 0]  # to all axes
        yield Course("plush_half", capture, round_, nearest + 0 * round_)


def placed(camera: clod.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Eye and viewing direction."""
    return camera.position.double().numpy(), camera.viewmat[2, :3].double().numpy()


def with_dial(gaussians: clod.Gaussians, camera: clod.Camera) -> clod.Gaussians:
    """The town with a dial that keeps a share of s^-1.2 at the distances from a camera, and culls small ones first."""
    attenuation = clod.AttenuationConfig(max_sv=7.0)
    order = gaussians.log_scales.max(1).values.argsort(descending=True)
    rank = torch.empty(len(order)).scatter_(0, order, (torch.arange(len(order)) + 1.0) / len(order))
    d = (gaussians.means - camera.position).norm(dim=1)
    sigma_d = sigma_for_extinction(gaussians.opacity_logits, d, rank ** (-1 / 1.2), attenuation)
    return gaussians.replace(sigma_d=sigma_d, attenuation=attenuation)


def measure(chromium: Any, course: Course, rival: Path) -> Row:
    row: Row = {"course": course.name, "canvas": SIZE, "chromium": chromium.version, "package": PACKAGE}
    for name, script in (("worker", ""), ("webgpu", REAL_GPU)):
        row[name] = ours(chromium, course, script)
    return row | {"supersplat": theirs(chromium, course, rival)}


@contextmanager
def tab(chromium: Any, *scripts: str) -> Iterator[Any]:
    with chromium.new_context(viewport=SIZE) as context:
        context.set_default_timeout(300_000)
        page = context.new_page()
        for script in scripts:
            page.add_init_script(script)
        yield page


def ours(chromium: Any, course: Course, script: str) -> Row:
    """Frames without the dial and at each value; a ``script`` makes the page sort by WebGPU, without the dial only."""
    cameras = page_config({"name": ""}, None, course.cameras(), 1.0)["cameras"]
    with serve(course.path) as url, tab(chromium, COUNT, script) as page:
        began = cpu_seconds()
        shown = Shown(page).ready(url)
        page.evaluate("firstFrame()")
        found: Row = {"first_picture": first_picture(page, began)}
        if script and not sorts_on_gpu(shown, 60):
            return found | {"absent": "no WebGPU adapter"}
        shown.run("clod.setCamera(given)", cameras[0])
        page.evaluate(TURNING % TURN, cameras)
        for name, dial in {"dial off": 0.0}.items() if script else STATES.items():
            page.evaluate("(dial) => (clod.setEquation(dial > 0), clod.setDial(dial || 1))", dial)
            found[name] = frames(page) | page.evaluate("clod.counts()")
        assert not shown.errors, shown.errors
        return found


def theirs(chromium: Any, course: Course, public: Path) -> Row:
    """In its world x and y are the negative of the file's; its script needs all settings."""
    flip = np.array([-1.0, -1.0, 1.0])
    seconds = TURN / STEPS * np.arange(STEPS)
    poses = {"position": (course.eyes * flip).ravel().tolist(), "target": (course.targets * flip).ravel().tolist()}
    track = {
        "name": "circle", "duration": TURN, "frameRate": 1, "loopMode": "repeat", "interpolation": "spline",
        "smoothness": 1, "keyframes": {"times": seconds.tolist(), "values": poses | {"fov": [FOV] * STEPS}},
    }  # fmt: skip
    settings = {
        "version": 2, "tonemapping": "none", "highPrecisionRendering": False, "background": {"color": [0, 0, 0]},
        "postEffectSettings": {name: {"enabled": False} for name in EFFECTS}, "animTracks": [track], "cameras": [],
        "annotations": [], "startMode": "animTrack",
    }  # fmt: skip
    (public / "settings.json").write_text(json.dumps(settings))
    scene = public / "scene.ply"
    scene.unlink(missing_ok=True)
    scene.symlink_to(course.path.resolve())
    with static(public) as url, tab(chromium, COUNT) as page:
        began = cpu_seconds()
        page.goto(f"{url}index.html?webgl&noui&content=scene.ply")
        found: Row = {"first_picture": first_picture(page, began)} | frames(page)
        canvas = page.evaluate("(({ width, height }) => ({ width, height }))(document.querySelector('canvas'))")
        assert canvas == SIZE
        return found


@contextmanager
def static(folder: Path) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def first_picture(page: Any, began: float) -> Row:
    """Its times since the navigation, which began at this CPU time."""
    return {"ms": page.evaluate("complete"), "cpu_ms": 1000 * (cpu_seconds() - began)}


def frames(page: Any) -> Row:
    """The mean interval of drawn frames, while the camera turns."""
    page.wait_for_timeout(1000 * WARM)
    page.evaluate("drawnAt.length = 0")
    began = cpu_seconds()
    at: list[float] = []
    while len(at) < 3:
        page.wait_for_timeout(1000 * SECONDS)
        at = page.evaluate("drawnAt")
    cpu = cpu_seconds() - began
    found = {"ms": (at[-1] - at[0]) / (len(at) - 1), "cpu_ms": 1000 * cpu / len(at), "frames": len(at)}
    print(found, file=sys.stderr)
    return found


def cpu_seconds() -> float:
    """Of all processes that this one started, and of theirs."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = path.read_text("utf-8").rpartition(")")[2].split()
            found[int(path.parent.name)] = int(fields[1]), int(fields[11]) + int(fields[12])

    def ours(pid: int) -> bool:
        return pid in found and (found[pid][0] == os.getpid() or ours(found[pid][0]))

    return sum(ticks for pid, (_, ticks) in found.items() if ours(pid)) / os.sysconf("SC_CLK_TCK")


def summary() -> str:
    """The last row of each course: CPU and wall ms of a frame, and in brackets the share of SuperSplat's; Markdown."""
    rows = {row["course"]: row for row in stored(FILE)}
    heads = ["", "time", "SuperSplat", *STATES, "first picture", "SuperSplat"]
    return table(heads, (cells(row, *measure) for row in rows.values() for measure in MEASURES.items()), 2)


def cells(row: Row, time: str, key: str) -> list[str]:
    theirs, ours = row["supersplat"], row["worker"]
    rival = theirs[key]
    own = [ours[name][key] for name in STATES]
    return [
        row["course"], time, f"{rival:.0f}", *(f"{ms:.0f} ({ms / rival:.0%})".replace("%", " %") for ms in own),
        *(f"{each['first_picture'][key]:.0f}" for each in (ours, theirs)),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
