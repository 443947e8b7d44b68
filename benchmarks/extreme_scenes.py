"""The capture ``ci_banana`` with one extreme change to the checkpoint, the cameras, the photographs or the settings."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import clod_adapter as clod
from clod_adapter.cameras import Camera, Scene, View, in_its_unit
from clod_adapter.gaussians import SH_C0
from clod_adapter.io.scene.colmap import write_model
from common import capture

import numpy as np
import pycolmap
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

CAPTURE = "ci_banana"
RATIO = math.log(1e6)


@dataclass(frozen=True)
class Case:
    """A base, its scene, and settings besides the number of steps."""

    base: clod.Gaussians
    scene: Scene
    settings: dict[str, Any] = field(default_factory=dict)


Change = Callable[[clod.Gaussians, Scene], Case]


def similar(scale: float) -> Change:
    """The same scene in other units."""

    def change(base: clod.Gaussians, scene: Scene) -> Case:
        larger = base.replace(means=base.means * scale, log_scales=base.log_scales + math.log(scale))
        return Case(larger, of_cameras(scene, lambda camera: moved(camera, camera.position * scale)))

    return change


def one_view_in(scale: float) -> Change:
    """A single training image, and the same in other units: one camera does not define the size of a scene."""

    def change(base: clod.Gaussians, scene: Scene) -> Case:
        case = similar(scale)(base, scene)
        return dataclasses.replace(case, scene=Scene(case.scene.train[:1], case.scene.test))

    return change


def floater(base: clod.Gaussians, scene: Scene) -> Case:
    means, scales = base.means.clone(), base.log_scales.clone()
    ahead = scene.train[0].camera
    means[0] = ahead.position + 1e6 * size_of(base) * ahead.viewmat[2, :3]
    scales[0] = math.log(1e4 * size_of(base))
    return Case(base.replace(means=means, log_scales=scales), scene)


def only_one(base: clod.Gaussians, scene: Scene) -> Case:
    one = base.select(torch.tensor([0]))
    mean = torch.stack([view.image.float().mean((0, 1)) for view in scene.train]).mean(0) / 255
    return Case(
        one.replace(
            means=base.means.median(0).values[None], log_scales=torch.full((1, 3), math.log(size_of(base) / 2)),
            opacity_logits=torch.full((1,), 2.0), sh0=((mean - 0.5) / SH_C0)[None, None], shN=torch.zeros(1, 0, 3),
        ),
        scene,
    )  # fmt: skip


def all_in_one_place(base: clod.Gaussians, scene: Scene) -> Case:
    return Case(base.replace(means=base.means.median(0).values.expand(len(base), 3).clone()), scene)


def behind(base: clod.Gaussians, scene: Scene) -> Case:
    """A third of the training cameras look away from the scene; their photographs are black."""

    def away(view: View) -> View:
        back = torch.diag(torch.tensor([-1.0, 1, -1]))
        turned = view.camera.viewmat.clone()
        turned[:3, :3] = back @ turned[:3, :3]
        out = view.camera.position - 100 * size_of(base) * view.camera.viewmat[2, :3]
        turned[:3, 3] = -turned[:3, :3] @ out
        return View(dataclasses.replace(view.camera, viewmat=turned), torch.zeros_like(view.image))

    train = tuple(away(view) if k % 3 == 0 else view for k, view in enumerate(scene.train))
    return Case(base, dataclasses.replace(scene, train=train))


def inside(base: clod.Gaussians, scene: Scene) -> Case:
    """A Gaussian around a training camera, one around a held-out one, and one with its centre in the lens."""
    means, scales, logits = base.means.clone(), base.log_scales.clone(), base.opacity_logits.clone()
    for row, view in enumerate((scene.train[0], scene.test[0])):
        means[row], scales[row], logits[row] = view.camera.position, math.log(0.1 * size_of(base)), -1.0
    return Case(base.replace(means=means, log_scales=scales, opacity_logits=logits), scene)


def opacity(value: float) -> Change:
    logit = math.log(value / (1 - value))
    return lambda base, scene: Case(base.replace(opacity_logits=torch.full_like(base.opacity_logits, logit)), scene)


def flat(axes: int) -> Change:
    """The smallest ``axes`` axes a millionth of the largest: 1 for discs, 2 for needles."""

    def change(base: clod.Gaussians, scene: Scene) -> Case:
        order = base.log_scales.argsort(1)[:, :axes]
        shrunk = base.log_scales.amax(1, keepdim=True) - RATIO
        return Case(base.replace(log_scales=base.log_scales.scatter(1, order, shrunk.expand(-1, axes))), scene)

    return change


def black(base: clod.Gaussians, scene: Scene) -> Case:
    def dark(views: tuple[View, ...]) -> tuple[View, ...]:
        return tuple(View(view.camera, torch.zeros_like(view.image)) for view in views)

    return Case(base, Scene(dark(scene.train), dark(scene.test)))


def twice(base: clod.Gaussians, scene: Scene) -> Case:
    return Case(base, Scene((*scene.train, scene.train[0]), scene.test))


def with_(**settings: Any) -> Change:
    return lambda base, scene: Case(base, scene, settings)


def georeferenced(kind: str) -> Change:
    """Coordinates a million units off, as file of ``kind`` f4 or f8 and COLMAP model; read back by our readers."""

    def change(base: clod.Gaussians, scene: Scene) -> Case:
        offset = np.array([437_000.0, 4_481_000.0, 1_000_000.0])
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            model = pycolmap.Reconstruction(str(capture(CAPTURE) / "sparse" / "0"))
            model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), offset))
            (folder / "sparse" / "0").mkdir(parents=True)
            model.write_binary(str(folder / "sparse" / "0"))
            (folder / "images").symlink_to((capture(CAPTURE) / "images").resolve())
            clod.save(folder / "plain.ply", base)
            rows = PlyData.read(str(folder / "plain.ply"))["vertex"].data
            types = [(n, kind if n in ("x", "y", "z") else rows.dtype[n]) for n in rows.dtype.names]
            shifted = rows.astype(types)
            for axis, by in zip("xyz", offset, strict=True):
                shifted[axis] = rows[axis].astype("f8") + by
            PlyData([PlyElement.describe(shifted, "vertex")]).write(str(folder / "utm.ply"))
            checkpoint = clod.load(folder / "utm.ply")
            return Case(checkpoint.gaussians, clod.load_scene(folder, origin=checkpoint.origin))

    return change


def with_alpha(base: clod.Gaussians, scene: Scene) -> Case:
    """Photographs cut out along a soft circle, as PNG with alpha, read back by our reader."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        for view in (*scene.train, *scene.test):
            y, x = np.mgrid[-1 : 1 : view.camera.height * 1j, -1 : 1 : view.camera.width * 1j]
            alpha = np.clip(4 * (1 - np.hypot(x, y)), 0, 1) * 255
            rgba = np.dstack([view.image.numpy(), alpha.astype(np.uint8)])
            Image.fromarray(rgba).save(folder / "images" / f"{view.camera.name}.png")
        views = sorted((*scene.train, *scene.test), key=lambda view: view.camera.name)
        cameras = [view.camera for view in views]
        write_model(folder, cameras, [f"{camera.name}.png" for camera in cameras])
        return Case(base, clod.load_scene(folder))


def of_cameras(scene: Scene, change: Callable[[Camera], Camera]) -> Scene:
    train, test = (tuple(View(change(v.camera), v.image) for v in views) for views in (scene.train, scene.test))
    return in_its_unit(Scene(train, test))


def moved(camera: Camera, position: torch.Tensor) -> Camera:
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return dataclasses.replace(camera, viewmat=viewmat)


def size_of(base: clod.Gaussians) -> float:
    """Of the bulk of the scene, in world units."""
    low, high = (base.means.quantile(q, 0) for q in (0.1, 0.9))
    return float((high - low).norm())


CASES: dict[str, Change] = {
    "as it is": with_(),
    "offset by 1e6, stored as double": georeferenced("f8"),
    "offset by 1e6, stored as float": georeferenced("f4"),
    "scaled by 1e-4": similar(1e-4),
    "scaled by 1e4": similar(1e4),
    "one floater at 1e6 times the size": floater,
    "one Gaussian in all": only_one,
    "all Gaussians in one place": all_in_one_place,
    "all behind a third of the cameras": behind,
    "cameras inside Gaussians": inside,
    "opacities all 0.99": opacity(0.99),
    "opacities all 0.01": opacity(0.01),
    "discs, axes 1e6 : 1": flat(1),
    "needles, axes 1e6 : 1": flat(2),
    "a single training image": one_view_in(1.0),
    "a single training image, scaled by 1e-4": one_view_in(1e-4),
    "a single training image, scaled by 1e4": one_view_in(1e4),
    "black images": black,
    "images with alpha": with_alpha,
    "two cameras at one place": twice,
    "max_sv 1": with_(max_sv=1.0),
    "max_sv 100, tau 0.004": with_(max_sv=100.0, tau=0.004),
    "max_sv 100, tau 0.004, 1,500 steps": with_(max_sv=100.0, tau=0.004, iters=1500),
}
