"""The errors of levels of detail, by which viewers choose them: of the leaves of a streamed set, and of a tile set.

Viewers of streamed sets share a budget of Gaussians among the leaves. They start with every leaf at its coarsest level
and take single steps to finer ones, those first that have most

    coverage error_removed / Gaussians_added

with ``coverage`` of the leaf from where the viewer is. That is the squared error of the image that a Gaussian removes,
if the step of leaf k from level l to the next finer l' removes

    sum_v (|I_v(l) - I_v(0)|^2 - |I_v(l; k at l') - I_v(0)|^2) / sum_v c_kv

where ``I_v(l)`` is the image from camera v with every leaf at level l, ``I_v(l; k at l')`` the same with leaf k alone
at l', ``|.|^2`` the mean over pixels and channels, and ``c_kv`` the leaf's coverage from there. Steps that remove less
than nothing count 0. The others are measured among leaves of their own level, since the errors of leaves that overlap
in the image add up. Divided by the mean of ``|I_v(0)|^2``, errors have no unit.

A leaf that no camera sees has no such error, and a viewer would not refine it. So each table has FLOOR of the errors
that viewers take without tables, ``log(finest_count / count)``, scaled to the others.

Sources: playcanvas/engine 2.22, ``gsplat-lod-table.js`` and ``gsplat-octree-instance.js``; playcanvas/splat-transform
3.7, whose own errors, of a leaf alone and relative to its image, need a GPU.

The levels of a tile set have an error that is a length (``geometric_errors``). A viewer of 3D Tiles shows a tile where
its ``geometricError`` g at distance d covers at most a number of pixels, 16 by default:

    g f / d <= 16

with f the focal length in pixels. Two images of which one is the other shifted by e pixels differ by about e times
their slope. So level l is as far from the finest as a shift of

    e_l = |I_l - I_0| / |dI_0|

pixels, with ``|.|`` root mean squares over pixels and channels and ``dI_0`` the mean slope of the image along x and y.
Seen from d this is the length ``e_l d / f``. Its mean over cameras, with d the median distance of the Gaussians in the
image, is the error of the level. Times 16, the default of viewers allows a shift of one pixel.

Source of the rule: 3D Tiles 1.1 (OGC 22-025r4), "Geometric error"; CesiumJS's ``maximumScreenSpaceError`` is 16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from clod_adapter.calibration import Viewpoint
from clod_adapter.cameras import Camera
from clod_adapter.equation.distances import median_distance
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.formats.lod_meta import Leaf
from clod_adapter.io.formats.tileset import ALLOWED
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import render, splat
from clod_adapter.training.camera_placement import FIELD, HEIGHT, WIDTH

VIEWS = 16  # cameras that errors are measured from
FLOOR = 0.01  # share of the errors by counts
LARGE = 0.4  # share of an image above which a part of it, of which all levels are needed, takes longer than the whole
REACH = 3.4  # standard deviations at which a Gaussian ends


def coverage(leaf: Leaf, camera: Camera) -> float:
    """Squared projected radius of a leaf's bounding sphere, in [0, 1], as viewers take it; 1 within its box.

    ``(r / (r + d))^2`` with d the distance from the camera to the box.
    """
    bound, place = leaf.bound, camera.position.cpu().double().numpy()
    radius = float(np.linalg.norm(bound[1] - bound[0])) / 2
    distance = float(np.linalg.norm(place - place.clip(*bound)))
    return (radius / max(radius + distance, 1e-12)) ** 2


def errors_by_count(leaf: Leaf, levels: int) -> np.ndarray:
    """``[L]`` what viewers take without a table: ``log(finest_count / count)``, 0 for levels that the leaf lacks."""
    counts = np.array([max(leaf.node["lods"].get(str(level), {"count": 0})["count"], 0) for level in range(levels)])
    return np.where(counts > 0, np.log(counts[leaf.levels[0]] / counts.clip(1)), 0.0)  # type: ignore[no-any-return]


def looking(places: Sequence[Camera | Viewpoint], gaussians: Gaussians) -> list[Camera]:
    """The cameras; a viewpoint has no direction, and looks at the median of the centres."""
    middle = gaussians.means.median(0).values.cpu().double().numpy()
    return [place if isinstance(place, Camera) else _toward(middle, place) for place in places]


def _toward(target: np.ndarray, viewpoint: Viewpoint) -> Camera:
    place = np.array([viewpoint.x, viewpoint.y, viewpoint.z])
    forward = target - place
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12) if forward.any() else np.array([0.0, 0.0, 1.0])
    right = np.cross(np.eye(3)[np.abs(forward).argmin()], forward)
    right /= np.linalg.norm(right)
    viewmat, focal = np.eye(4), WIDTH / 2 / np.tan(np.radians(FIELD) / 2)
    viewmat[:3, :3] = right, np.cross(forward, right), forward
    viewmat[:3, 3] = -viewmat[:3, :3] @ place
    K = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]], dtype=torch.float32)
    return Camera(torch.from_numpy(viewmat).float(), K.float(), WIDTH, HEIGHT)


def _picked(cameras: Sequence[Camera]) -> list[Camera]:
    """At most VIEWS of them, evenly chosen."""
    return [cameras[k] for k in np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round().astype(int)]


@torch.no_grad()
def level_errors(
    levels: Sequence[Gaussians], leaves: Sequence[Leaf], cameras: Sequence[Camera], *, progress: Listener | None = None
) -> np.ndarray:
    """``[K, L]`` float64, >= 0: the error of each level of each leaf (above); ascending, 0 for the finest level of a
    leaf and for levels that it lacks.

    Args:
        levels: the Gaussians of each level, without a dial, the finest first.
        leaves: of the set made from them.
        cameras: at least one; VIEWS of them are used, evenly chosen.
        progress: called in ``Phase.LEVELS`` after each camera.
    """
    scene, found = _Scene(levels, leaves), np.zeros((len(leaves), len(levels)))
    picked = _picked(cameras)
    energy, covered = 0.0, np.zeros((len(leaves), 1))
    for done, view in enumerate(picked):
        images = [scene.picture(opacities, view) for opacities in scene.shown]
        found += [scene.removed(leaf, view, images) for leaf in leaves]
        covered[:, 0] += [coverage(leaf, view) for leaf in leaves]
        energy += float(images[0].square().mean())
        tell(progress, Phase.LEVELS, done + 1, len(picked))
    errors = (found.clip(0) / covered.clip(1e-12)).cumsum(1) * (len(picked) / max(energy, 1e-12))
    counts = np.array([errors_by_count(leaf, len(levels)) for leaf in leaves])
    errors += FLOOR * errors.sum() / max(counts.sum(), 1e-12) * counts
    has = [[level in leaf.levels for level in range(len(levels))] for leaf in leaves]
    return np.where(has, np.maximum.accumulate(errors, 1), 0.0)  # type: ignore[no-any-return]


class _Scene:
    """All levels in one set of tensors; Gaussians that an image lacks have the opacity 0.

    Attributes:
        shown: for each level the opacities ``[N]`` with every leaf at that level, or the next finer one that it has.
    """

    def __init__(self, levels: Sequence[Gaussians], leaves: Sequence[Leaf]) -> None:
        joined = {name: torch.cat([level.tensors()[name] for level in levels]) for name in levels[0].tensors()}
        self.gaussians = levels[0].replace(**joined)
        self.scales, self.opacities = self.gaussians.scales, self.gaussians.opacities
        self.starts = np.cumsum([0, *map(len, levels)])
        self.shown = [torch.zeros_like(self.opacities) for _ in levels]
        for level, opacities in enumerate(self.shown):
            for leaf in leaves:
                rows = self._rows(leaf, max((at for at in leaf.levels if at <= level), default=leaf.levels[0]))
                opacities[rows] = self.opacities[rows]

    def _rows(self, leaf: Leaf, level: int) -> Tensor:
        return torch.from_numpy(leaf.rows[level] + self.starts[level]).to(self.opacities.device)

    def picture(self, opacities: Tensor, camera: Camera) -> Tensor:
        """``[H, W, 3]`` over black, in [0, 1]."""
        return splat(self.gaussians, opacities, camera)[0].clamp(0, 1)

    def removed(self, leaf: Leaf, camera: Camera, images: Sequence[Tensor]) -> np.ndarray:
        """``[L]`` what the step to each level from the next finer one adds to the squared error from a camera.

        Args:
            images: of ``shown`` from there.
        """
        found, window = np.zeros(len(self.starts) - 1), self._window(leaf, camera)
        if window is None:
            return found
        if window.width * window.height > LARGE * camera.width * camera.height:
            window = camera
        else:
            images = [self.picture(opacities, window) for opacities in self.shown]

        def error(image: Tensor) -> float:
            return float((image - images[0]).square().sum())

        for finer, level in pairwise(leaf.levels):
            swapped, rows = self.shown[level].clone(), self._rows(leaf, finer)
            swapped[self._rows(leaf, level)] = 0
            swapped[rows] = self.opacities[rows]
            found[level] = error(images[level]) - error(self.picture(swapped, window))
        return found / (3 * camera.width * camera.height)

    def _window(self, leaf: Leaf, camera: Camera) -> Camera | None:
        """The part of a camera's image that a leaf can reach; None if it reaches none."""
        rows = torch.cat([self._rows(leaf, level) for level in leaf.levels])
        viewmat, K = camera.viewmat.to(self.scales), camera.K.to(self.scales)
        places = self.gaussians.means[rows] @ viewmat[:3, :3].T + viewmat[:3, 3]
        front = places[:, 2] > camera.near
        places, reach = places[front], REACH * self.scales[rows][front].amax(1, keepdim=True)
        centres, reach = (places @ K.T)[:, :2] / places[:, 2:], reach * K.diagonal()[:2] / places[:, 2:] + 2
        size = torch.tensor([camera.width, camera.height]).to(centres)
        low, high = (centres - reach).clamp(min=0).floor(), torch.minimum(centres + reach, size).ceil()
        inside = (low < high).all(1)
        if not inside.any():
            return None
        (x, y), (right, bottom) = low[inside].amin(0).int().tolist(), high[inside].amax(0).int().tolist()
        moved = camera.K.clone()
        moved[:2, 2] -= torch.tensor([x, y]).to(moved)
        return replace(camera, K=moved, width=right - x, height=bottom - y)


@torch.no_grad()
def geometric_errors(
    levels: Sequence[Gaussians], cameras: Sequence[Camera], *, progress: Listener | None = None
) -> np.ndarray:
    """``[L]`` float64, >= 0, world units: 0 for the finest level, ascending.

    Args:
        levels: without a dial, the finest first.
        cameras: at least one; VIEWS of them are used, evenly chosen.
        progress: called in ``Phase.LEVELS`` after each camera.
    """
    picked = _picked(cameras)
    found = np.zeros((len(picked), len(levels)))
    for done, view in enumerate(picked):
        images = [render(level, view).image.clamp(0, 1) for level in levels]
        slope = max(_slope(images[0]), 1e-6)
        length = median_distance(levels[0].means, view) / float(view.K[0, 0])
        found[done] = [length / slope * float((image - images[0]).square().mean().sqrt()) for image in images]
        tell(progress, Phase.LEVELS, done + 1, len(picked))
    return ALLOWED * np.maximum.accumulate(found.mean(0))  # type: ignore[no-any-return]


def _slope(image: Tensor) -> float:
    """Root mean square of the differences between neighbouring pixels, along x and y."""
    across, down = image.diff(dim=1).square().mean(), image.diff(dim=0).square().mean()
    return float(((across + down) / 2).sqrt())
