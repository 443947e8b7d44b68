"""The dial against streamed sets of levels, both drawn as a viewer draws them: PSNR at equal
budgets.

    python benchmarks/stream.py SCENE.ply --record    # without photographs
    python benchmarks/stream.py SCENE.ply --images FOLDER --record    # with photographs
    python benchmarks/stream.py SCENE.ply --author LEVEL.ply ... --record    # its author's, too

SCENE is adapted without options. Its rivals are sets whose finest level is SCENE itself: halved
again and again by splat-transform (``make peers``) in both its ways, and the author's own. The
levels of ``export --lod-meta`` are drawn too. No set is packed. Above ADAPTIVE Gaussians a set
halved adaptively is left out: without a GPU splat-transform cannot make it. A set is drawn by the
rule of PlayCanvas 2.23 (gsplat-octree-instance.js, gsplat-budget-balancer.js): a node's distance is
that of the nearest point of its box, times up to BEHIND where that is behind the camera; level b >=
1 begins at K multiplier^(b - 1); in each frame one K for all nodes is such that their counts, in
view or not, meet the budget. A set has the multiplier of MULTIPLIERS that is best for it. The dial
has the value that keeps as many Gaussians in that frame, in view or not, by distances with the same
factor; "all alike" is without the factor. Plain files are drawn as they are: each halved one, and
``export --keep`` of its count. PSNR is that of the mean squared error over VIEWS placed cameras,
four times as many for plain files, against renders of SCENE, or over held-out photographs.
"""

import json
import math
import tempfile
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import clod_adapter as clod
from clod_adapter.equation.attenuation import dial, smallest_dial
from clod_adapter.losses import decibels, mean_squared_error
from common import Table, append, arguments, clod_adapt, last, percent, with_best
from tuning import TIMEOUT, find_tool

import numpy as np
import torch

FILE, VIEWS, SEED = "stream.jsonl", 16, 77
BUDGETS, MULTIPLIERS = (0.4, 0.18, 0.08, 0.04), (1.6, 2.0, 3.0)
LEAF, HALVED = 8192, 6  # Gaussians of a node; times that SCENE is halved
ADAPTIVE = 1 << 21
BEHIND = 1.5  # factor of the distance of what is straight behind the camera: lodBehindPenalty
SETS = {"halved": "--decimate", "halved adaptively": "--decimate-adaptive"}
SCENES = {  # of the tables
    "taebak4": "an aerial scene of 212,464, the coarsest level of a larger one",
    "taebak": "that larger one, 4,249,286",
    "garden2": "a garden of 843,068 by another author",
    "showroom3": "a showroom of 747,000 by that author",
    "playbot": "a robot of 500,000, SH degree 2 (PLAYBOT by Stephane Agullo, CC BY 4.0)",
    "plush_half": "a plush toy, 120,000, photographs",
    "bonsai146": "a table in a room, 150,000, photographs",
}
SHOWN = {
    "dial": "this dial, one file",
    "lod-meta": "this file's levels, `export --lod-meta`",
    "halved": "halved uniformly",
    "halved adaptively": "halved adaptively",
    "author": "its author's levels",
}


def main():
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--images", type=Path, help="photographs; without it there are none")
    text = "its author's coarser levels, the finest first"
    parser.add_argument("--author", nargs="+", type=Path, default=[], help=text)
    args = parser.parse_args()
    base = clod.load(args.scene).gaussians
    if args.images:
        scene, views = args.images.name, clod.load_scene(args.images).test
        more = views
    else:
        scene, views = args.scene.stem, rendered(base)
        # of plain files, where what is near counts most, few views disagree by decibels
        more = rendered(base, 4 * VIEWS)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        out = folder / "adapted.ply"
        words = ["--images", args.images] if args.images else []
        run = clod_adapt(args.scene, *words, "--out", out, "--json", "--accept-loss")
        row = {"method": "run", "steps": json.loads(run.out)["steps"], **run.cost()}
        append(FILE, {"scene": scene, **row}, args.record)
        for row in of_dial(base, out, views):
            append(FILE, {"scene": scene, **row}, args.record)
        sets = sets_of(args.scene, args.author, base, clod.load(out).gaussians, folder)
        for row in chain(of_plain(out, sets, more, len(base)), of_sets(base, sets, views)):
            append(FILE, {"scene": scene, **row}, args.record)


def of_dial(base, adapted, views):
    """The dial at 1, 2 and 5, and at each budget."""
    model = clod.load(adapted).gaussians
    for s in (0.0, 1.0, 2.0, 5.0):
        (row,) = clod.evaluate(clod.detach(model) if s == 0 else model, views, [max(s, 1.0)])
        share = row.kept / len(base)
        yield {"method": "dial", "level": f"s = {s:g}", "share": share, "psnr": row.psnr}
    for name, behind in (("dial", BEHIND), ("dial, all alike", 1.0)):
        for budget in BUDGETS:
            yield {"method": name, **measured(Dial(model, behind), views, budget, len(base))}


def sets_of(scene, author, base, adapted, folder):
    """The levels of each set for each multiplier, the finest first."""
    options = dict(SETS)
    if len(base) > ADAPTIVE:
        del options["halved adaptively"]
    rivals = {name: halved(scene, option, folder / name) for name, option in options.items()}
    if author:
        rivals["author"] = author
    sets = {name: of_files(scene, coarser) for name, coarser in rivals.items()}
    sets["lod-meta"] = {each: own_levels(adapted, each) for each in MULTIPLIERS}
    return sets


def of_files(scene, coarser):
    """Their levels, the same for each multiplier."""
    levels = [clod.load(file).gaussians for file in (scene, *coarser)]
    return dict.fromkeys(MULTIPLIERS, levels)


def of_plain(adapted, sets, views, whole):
    """Plain files of the same counts, drawn everywhere: ``export --keep``, and the merged ones."""
    for name in filter(sets.get, SETS):
        for merged in sets[name][MULTIPLIERS[0]][1:]:
            share = len(merged) / whole
            yield {"method": f"{name}, plain", **measured(Plain(merged), views, share, whole)}
    plain = adapted.with_name("plain.ply")
    for merged in sets["halved"][MULTIPLIERS[0]][1:]:
        clod_adapt("export", adapted, "--keep", len(merged), "--quiet", "--out", plain)
        gaussians = clod.load(plain).gaussians
        share = len(merged) / whole
        yield {"method": "plain", **measured(Plain(gaussians), views, share, whole)}


def of_sets(base, sets, views):
    """Each set at each budget, with the multiplier that is best of those that meet it."""
    frames = Frames(base)
    for name, by_multiplier in sets.items():
        drawn = {each: Levels(levels, each, frames) for each, levels in by_multiplier.items()}
        for budget in BUDGETS:
            rows = []
            for multiplier, shown in drawn.items():
                row = {"method": name, **measured(shown, views, budget, len(base))}
                rows.append(row | {"multiplier": multiplier})
            yield max(rows, key=lambda row: (within(row, budget), row["psnr"]))


def within(row, budget):
    """Whether a set met a budget: nodes around the camera may be more than it."""
    return row["share"] < 1.01 * budget


def rendered(base, views=VIEWS):
    """The checkpoint's own renders from placed cameras that training does not use."""
    cameras = clod.place_cameras(base, views=views, seed=SEED)
    with torch.no_grad():
        return [clod.View(camera, clod.render(base, camera).pixels) for camera in cameras]


def measured(shown, views, budget, whole):
    """PSNR over the views, and the mean share drawn."""
    errors, counts = [], []
    for view in views:
        gaussians, s, count = shown.frame(view.camera, round(budget * whole))
        with torch.no_grad():
            image = clod.render(gaussians, view.camera, virtual_scale=s).image
        errors.append(mean_squared_error(image, view.image))
        counts.append(count)
    psnr = decibels(float(np.mean(errors)))
    return {"level": f"{budget:.0%}", "share": float(np.mean(counts)) / whole, "psnr": psnr}


@dataclass
class Dial:
    gaussians: clod.Gaussians
    behind: float = BEHIND  # 1 where all directions count alike

    def frame(self, camera, count):
        """What is drawn of about ``count`` Gaussians, the dial value, and their exact number."""
        away = (self.gaussians.means - camera.position).double().numpy()
        distances = torch.from_numpy(penalized(away, camera, self.behind))
        distances /= self.gaussians.attenuation.scene_distance

        def kept(s):
            return int(dial(self.gaussians, distances, s).keep.sum())

        s = smallest_dial(lambda s: kept(s) <= count, 1e-3, 1e3, 1e-6)
        return self.gaussians, s, kept(s)


@dataclass
class Plain:
    gaussians: clod.Gaussians

    def frame(self, camera, count):
        """As ``Dial.frame``."""
        return self.gaussians, 1.0, len(self.gaussians)


class Cut(NamedTuple):
    """A node of the tree that is cut at a coordinate; a leaf is its number."""

    axis: int
    at: float
    below: "Cut | int"
    above: "Cut | int"


class Frames:
    """The nodes of a scene: a k-d tree of the checkpoint's centres, the same for every set."""

    def __init__(self, base):
        self.means, self.leaves = base.means.numpy(), []
        self.tree = self._cut(np.arange(len(base)))
        boxes = [self.means[rows] for rows in self.leaves]
        self.low, self.high = (
            np.stack([box.min(0) for box in boxes]),
            np.stack([box.max(0) for box in boxes]),
        )

    def _cut(self, rows):
        points = self.means[rows]
        axis = int(np.argmax(np.ptp(points, axis=0)))
        at = float(np.median(points[:, axis]))
        low = points[:, axis] <= at
        if len(rows) <= LEAF or low.all():
            self.leaves.append(rows)
            return len(self.leaves) - 1
        return Cut(axis, at, self._cut(rows[low]), self._cut(rows[~low]))

    def nodes(self, means):
        """``[N]`` the leaf of each centre."""
        found, todo = np.empty(len(means), np.int64), [(self.tree, np.arange(len(means)))]
        while todo:
            node, rows = todo.pop()
            if isinstance(node, Cut):
                low = means[rows, node.axis] <= node.at
                todo += [(node.below, rows[low]), (node.above, rows[~low])]
            else:
                found[rows] = node
        return found

    def distances(self, camera):
        eye = camera.position.double().numpy()
        return penalized(np.clip(eye, self.low, self.high) - eye, camera, BEHIND)


def penalized(away, camera, factor):
    """Distances, of what is straight behind the camera times the factor."""
    distances = np.linalg.norm(away, axis=1)
    cosines = away @ camera.viewmat[2, :3].double().numpy() / np.maximum(distances, 1e-9)
    return distances * (1 + (factor - 1) * np.maximum(-cosines, 0))


class Levels:
    """A set of levels, the finest first."""

    def __init__(self, levels, multiplier, frames):
        self.levels, self.step, self.frames = levels, math.log(multiplier), frames
        self.nodes = [frames.nodes(level.means.numpy()) for level in levels]
        self.counts = np.stack(
            [np.bincount(nodes, minlength=len(frames.leaves)) for nodes in self.nodes]
        )

    def frame(self, camera, count):
        """As ``Dial.frame``."""
        distances, every = self.frames.distances(camera), np.arange(len(self.frames.leaves))

        def chosen(K):
            bands = np.floor(np.log(np.maximum(distances, 1e-9) / K) / self.step).astype(int) + 1
            return np.clip(bands, 0, len(self.levels) - 1)

        low, high = 1e-5, 1e7
        for _ in range(60):
            K = math.sqrt(low * high)
            low, high = (low, K) if self.counts[chosen(K), every].sum() > count else (K, high)
        level = chosen(low)
        shown = [torch.from_numpy(level[nodes] == k) for k, nodes in enumerate(self.nodes)]
        parts = [gaussians.select(rows) for gaussians, rows in zip(self.levels, shown, strict=True)]
        joined = {}
        for name in parts[0].tensors():
            joined[name] = torch.cat([part.tensors()[name] for part in parts])
        return parts[0].replace(**joined), 1.0, int(self.counts[level, every].sum())


def halved(scene, option, folder):
    """SCENE halved HALVED times, the finest first."""
    folder.mkdir()
    files, count = [scene], len(clod.load(scene).gaussians)
    for k in range(1, HALVED + 1):
        files.append(folder / f"{k}.ply")
        find_tool().run("-q", files[-2], option, str(count >> k), files[-1], timeout=TIMEOUT)
    return files[1:]


def own_levels(adapted, multiplier):
    return [level.gaussians for level in clod.bake_levels(adapted, multiplier)]


def page_table(scene):
    """The methods at each budget; the best is bold."""
    found = last(FILE, "method", "level", scene=scene)
    rows = []
    lines = {}
    for method, label in SHOWN.items():
        line = [found.get((method, f"{budget:.0%}")) for budget in BUDGETS]
        if any(line):
            rows += filter(None, line)
            lines[label] = [
                row["psnr"] if row and within(row, budget) else None
                for row, budget in zip(line, BUDGETS, strict=True)
            ]
    heads = [f"{SCENES[scene]} (`{scene}`), budget", *percent(BUDGETS)]
    return Table(heads, with_best(lines, ".1f"), rows)


if __name__ == "__main__":
    main()
