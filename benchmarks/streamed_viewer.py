"""Streamed sets in PlayCanvas, in a headless Chromium, against the rule that stream.py draws.

    python benchmarks/streamed_viewer.py SCENE.ply --record

SCENE is adapted in 100 steps without photographs and exported with ``--lod-meta``. A placed camera,
and the same moved back by 2 and 8 times the median distance of the centres, see the set at each
budget: in PlayCanvas with the settings that the export prints, and by the rule with the file's own
nodes and the count that PlayCanvas draws. PSNR is what levels cost: against the finest level
everywhere, each drawn by its own program, as their filters differ. At budget 1 it is that level's
against renders of SCENE. Renders have the filter of PlayCanvas, VARIANCE: it adds its 0.3 to
covariances of half pixels. ``min_pixels`` is its ``minPixelSize``, by default 2, which leaves out
Gaussians of less than 0.125 px^2.
"""

import io
import json
import sys
import tempfile
import threading
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import product
from pathlib import Path

import clod_adapter as clod
from clod_adapter.config import ScreenFilter
from clod_adapter.losses import psnr
from common import ROOT, append, arguments, clod_adapt
from stream import SEED, VIEWS, Frames, Levels
from tuning import TIMEOUT, find_tool

import numpy as np
import torch

sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests/viewer")]
import browser  # noqa: E402

from test_drop_ins import engines, read_picture  # noqa: E402

FILE, MULTIPLIER = "streamed_viewer.jsonl", 3.0
MOVED = (0, 2, 8)  # medians of the distance, backwards
BUDGETS, MIN_PIXELS, VARIANCE = (1.0, 0.4, 0.08), (2, 0), 0.075
PAGE = """<!doctype html>
<style>body { margin: 0 }</style>
<canvas></canvas>
<script type="module">
import * as pc from "./playcanvas.mjs";

const canvas = document.querySelector("canvas");
const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false } });
app.setCanvasFillMode(pc.FILLMODE_FILL_WINDOW);
app.setCanvasResolution(pc.RESOLUTION_AUTO);
window.addEventListener("resize", () => app.resizeCanvas());
app.start();
const asset = new pc.Asset("set", "gsplat", { url: "set/lod-meta.json" });
await new Promise((loaded) => {
  asset.ready(loaded);
  app.assets.add(asset);
  app.assets.load(asset);
});
const camera = new pc.Entity(), splat = new pc.Entity(), settings = app.scene.gsplat;
camera.addComponent("camera", { clearColor: new pc.Color(0, 0, 0), nearClip: 0.01, farClip: 1e5 });
splat.addComponent("gsplat", { asset });
app.root.addChild(camera);
app.root.addChild(splat);
settings.lodUpdateDistance = settings.colorUpdateAngle = 0; // the camera jumps
settings.splatBudget = 1; // until there is a view
window.still = 0;
app.systems.gsplat.on("frame:ready", (_camera, _layer, ready, loading) => {
  window.still = ready && !loading ? window.still + 1 : 0;
});
window.view = (viewmat, focal, lodBaseDistance, lodMultiplier, splatBudget, minPixelSize) => {
  Object.assign(splat.gsplat, { lodBaseDistance, lodMultiplier });
  Object.assign(settings, { splatBudget, minPixelSize });
  const place = new pc.Mat4();
  place.set(viewmat).invert().mul(new pc.Mat4().setFromEulerAngles(180, 0, 0)); // -z is forward
  camera.setPosition(place.getTranslation());
  camera.setRotation(new pc.Quat().setFromMat4(place));
  camera.camera.fov = 2 * Math.atan(canvas.clientHeight / 2 / focal) * pc.math.RAD_TO_DEG;
  window.still = 0;
};
const set = () => {
  const [seen] = app.renderer.gsplatDirector.camerasMap.values();
  const [layer] = seen.layersMap.values();
  return [...layer.gsplatManager.world._octreeInstances.values()][0];
};
window.nodes = () => {
  const { nodes, nodeBoundsMinMax: ends, nodeBoundsExcess: excess } = set().octree;
  const shrunk = (k, at, sign) => [0, 1, 2].map(
    (i) => ends[6 * k + at + i] + sign * settings.lodDistanceShrink * excess[3 * k + i]);
  const low = nodes.map((_, k) => shrunk(k, 0, 1)), high = nodes.map((_, k) => shrunk(k, 3, -1));
  return [low, high, nodes.map((node) => node.lods.map((level) => level.count))];
};
window.drawn = () => {
  const { octree, nodeInfos } = set(), nodes = Array(octree.lodLevels).fill(0);
  let count_viewer = 0;
  nodeInfos.forEach(({ currentLod }, k) => {
    nodes[currentLod] += 1;
    count_viewer += octree.nodes[k].lods[currentLod].count;
  });
  return { count_viewer, nodes, min_pixels: settings.minPixelSize };
};
</script>"""


def main():
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("scene", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        model = folder / "adapted.ply"
        clod_adapt(args.scene, "--iters", 100, "--accept-loss", "--out", model)
        files = stored_levels(model, folder / "set")
        begins = clod.bake_levels(clod.load(model).gaussians, MULTIPLIER)[1].begins
        with shown(folder) as page:
            for row in compare(page, loaded(args.scene), files, begins):
                append(FILE, {"scene": args.scene.stem, **row}, args.record)


def stored_levels(model, folder):
    """The levels of ``export --lod-meta``, as splat-transform reads them."""
    clod_adapt("export", model, "--lod-meta", "--multiplier", MULTIPLIER, "--out", folder)
    meta, files = folder / "lod-meta.json", []
    for level in range(int(json.loads(meta.read_text("utf-8"))["lodLevels"])):
        files.append(folder / f"level{level}.ply")
        find_tool().run("-q", meta, "-L", str(level), files[-1], timeout=TIMEOUT)
    return files


def loaded(file):
    return clod.load(file).gaussians.replace(screen_filter=ScreenFilter(variance=VARIANCE))


def compare(page, base, files, begins):
    """PSNR and counts of both, and the viewer's nodes of each level."""
    camera = clod.place_cameras(base, views=VIEWS, seed=SEED)[0].halved()
    page.set_viewport_size({"width": camera.width, "height": camera.height})
    levels = Levels(list(map(loaded, files)), MULTIPLIER, Leaves(page))
    distance = (base.means - camera.position).norm(dim=1).median()
    for times in MOVED:
        viewmat = camera.viewmat.clone()
        viewmat[2, 3] += times * distance
        moved = replace(camera, viewmat=viewmat)
        wanted = clod.render(base, moved).pixels
        finest = {}
        for budget, pixels in product(BUDGETS, MIN_PIXELS):
            count = round(budget * len(base))
            given = [viewmat.T.ravel().tolist(), camera.K[1, 1].item(), begins, MULTIPLIER, count]
            picture = streamed(page, [*given, pixels])
            row = {"moved": times, "budget": budget} | page.evaluate("drawn()")
            gaussians, _, row["count"] = levels.frame(moved, row["count_viewer"])
            rendering = clod.render(gaussians, moved)
            if budget == 1.0:
                finest[pixels] = rendering.pixels, picture
                by_rule = by_viewer = wanted
            else:
                by_rule, by_viewer = finest[pixels]
            row["psnr"] = psnr(rendering.image, by_rule)
            row["psnr_viewer"] = psnr(picture / 255, by_viewer)
            yield row


def streamed(page, given):
    """The picture once it no longer changes."""
    page.evaluate("(given) => view(...given)", given)
    page.wait_for_function("window.still > 5")
    before, picture = b"", page.screenshot()
    while picture != before:
        page.wait_for_timeout(500)
        before, picture = picture, page.screenshot()
    return torch.from_numpy(read_picture(io.BytesIO(picture))).to(torch.uint8)


class Leaves:
    """The nodes of the set on the page, as ``stream.Frames``."""

    def __init__(self, page):
        self.low, self.high, self.leaves = map(np.array, page.evaluate("nodes()"))

    def nodes(self, means):
        """As ``Frames.nodes``, of a whole level: its rows are in the order of the nodes."""
        (counts,) = (each for each in self.leaves.T if each.sum() == len(means))
        return np.repeat(range(len(counts)), counts)

    distances = Frames.distances


@contextmanager
def shown(folder):
    """The page in a browser, with the set and PlayCanvas served over HTTP."""
    (folder / "index.html").write_text(PAGE)
    engine = engines() / "playcanvas/build/playcanvas.mjs"
    (folder / engine.name).symlink_to(engine)
    files = partial(SimpleHTTPRequestHandler, directory=folder)
    with ThreadingHTTPServer(("127.0.0.1", 0), files) as server, browser.launch() as chromium:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = chromium.new_page()
        page.set_default_timeout(600_000)
        page.goto(f"http://127.0.0.1:{server.server_port}")
        page.wait_for_function("window.still")
        yield page
        server.shutdown()


if __name__ == "__main__":
    with torch.no_grad():
        main()
