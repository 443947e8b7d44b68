"""Extreme scenes, each adapted by default and rendered over its dial: all finite, and no loss of
quality.

A case is the capture ``ci_banana`` with one extreme change to the checkpoint, the cameras, the
photographs or the settings. It holds when every picture over the dial is finite and the
full-quality end is at most 0.3 dB below the checkpoint itself on the same held-out views.
"""

import dataclasses
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import clod_adapter as clod
from clod_adapter.cameras import Scene, View, in_its_unit
from clod_adapter.training.pseudo_views import add_pseudo_views
from common import Table, capture, checkpoint, photographs, quality

import numpy as np
import pycolmap
import torch
from plyfile import PlyData, PlyElement

CAPTURE = "ci_banana"
ALLOWED = 0.3  # dB below the checkpoint


@dataclass(frozen=True)
class Case:
    """A base, its scene, and settings."""

    base: clod.Gaussians
    scene: Scene
    settings: dict[str, Any] = field(default_factory=dict)


Change = Callable[[clod.Gaussians, Scene], Case]


def similar(base, scene, scale):
    """The same scene in other units."""

    def resized(view):
        camera = view.camera
        return view.at(posed(camera, camera.viewmat[:3, :3], camera.position * scale))

    larger = base.replace(means=base.means * scale, log_scales=base.log_scales + math.log(scale))
    return Case(larger, in_its_unit(of_views(scene, resized)))


def one_view(base, scene, scale):
    """A single training image, in other units: one camera does not define the size of a scene."""
    case = similar(base, scene, scale)
    return dataclasses.replace(case, scene=Scene(case.scene.train[:1], case.scene.test))


def floater(base, scene):
    changed = copy_of(base)
    camera = scene.train[0].camera
    changed.means[0] = camera.position + 1e6 * size_of(base) * camera.viewmat[2, :3]
    changed.log_scales[0] = math.log(1e4 * size_of(base))
    return Case(changed, scene)


def behind(base, scene):
    """A third of the training cameras look away from the scene; their photographs are black."""

    def away(view):
        camera = view.camera
        back = torch.diag(torch.tensor([-1.0, 1, -1]))
        eye = camera.position - 100 * size_of(base) * camera.viewmat[2, :3]
        turned = posed(camera, back @ camera.viewmat[:3, :3], eye)
        return View(turned, torch.zeros_like(view.image))

    train = tuple(away(view) if k % 3 == 0 else view for k, view in enumerate(scene.train))
    return Case(base, dataclasses.replace(scene, train=train))


def inside(base, scene):
    """A Gaussian around a training camera, one around a held-out one, and one with its centre in
    the lens.
    """
    changed = copy_of(base)
    for row, view in enumerate((scene.train[0], scene.test[0])):
        changed.means[row] = view.camera.position
        changed.log_scales[row] = math.log(0.1 * size_of(base))
        changed.opacity_logits[row] = -1.0
    return Case(changed, scene)


def opacity(base, scene, value):
    logits = torch.full_like(base.opacity_logits, math.log(value / (1 - value)))
    return Case(base.replace(opacity_logits=logits), scene)


def flat(base, scene, axes):
    """The smallest ``axes`` axes a millionth of the largest: 1 for discs, 2 for needles."""
    order = base.log_scales.argsort(1)[:, :axes]
    shrunk = base.log_scales.amax(1, keepdim=True) - math.log(1e6)
    log_scales = base.log_scales.scatter(1, order, shrunk.expand(-1, axes))
    return Case(base.replace(log_scales=log_scales), scene)


def black(base, scene):
    return Case(base, of_views(scene, lambda view: View(view.camera, torch.zeros_like(view.image))))


def georeferenced(base, scene, kind):
    """Coordinates a million units off, as file of ``kind`` f4 or f8 and COLMAP model; read back by
    our readers.
    """
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
        kinds = {name: rows.dtype[name] for name in rows.dtype.names}
        shifted = rows.astype(list((kinds | dict.fromkeys("xyz", kind)).items()))
        for axis, by in zip("xyz", offset, strict=True):
            shifted[axis] = rows[axis].astype("f8") + by
        PlyData([PlyElement.describe(shifted, "vertex")]).write(str(folder / "utm.ply"))
        checkpoint = clod.load(folder / "utm.ply")
        return Case(checkpoint.gaussians, clod.load_scene(folder, origin=checkpoint.origin))


def one_place(base, scene):
    return Case(base.replace(means=base.means.median(0).values.repeat(len(base), 1)), scene)


def twice(base, scene):
    return Case(base, Scene((*scene.train, scene.train[0]), scene.test))


def copy_of(base):
    """A copy whose rows can be changed."""
    return base.replace(**{name: value.clone() for name, value in base.tensors().items()})


def posed(camera, rotation, eye):
    """The camera at another place, turned another way."""
    viewmat = camera.viewmat.clone()
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ eye
    return dataclasses.replace(camera, viewmat=viewmat)


def of_views(scene, change):
    return Scene(tuple(map(change, scene.train)), tuple(map(change, scene.test)))


def size_of(base):
    """Size of the bulk of the scene, in world units."""
    low, high = (base.means.quantile(q, 0) for q in (0.1, 0.9))
    return float((high - low).norm())


CASES: dict[str, Change] = {
    "as it is": Case,
    "offset by 1e6, stored as double": partial(georeferenced, kind="f8"),
    "scaled by 1e4": partial(similar, scale=1e4),
    "scaled by 1e-4": partial(similar, scale=1e-4),
    "one floater at 1e6 times the size": floater,
    "offset by 1e6, stored as float": partial(georeferenced, kind="f4"),
    "all Gaussians in one place": one_place,
    "all behind a third of the cameras": behind,
    "cameras inside Gaussians": inside,
    "opacities all 0.99": partial(opacity, value=0.99),
    "opacities all 0.01": partial(opacity, value=0.01),
    "discs, axes 1e6 : 1": partial(flat, axes=1),
    "needles, axes 1e6 : 1": partial(flat, axes=2),
    "a single training image": partial(one_view, scale=1.0),
    "a single training image, scaled by 1e-4": partial(one_view, scale=1e-4),
    "a single training image, scaled by 1e4": partial(one_view, scale=1e4),
    "black images": black,
    "two cameras at one place": twice,
    "max_sv 1": partial(Case, settings={"max_sv": 1.0}),
    "max_sv 100": partial(Case, settings={"max_sv": 100.0}),
}


TOGETHER = {  # in the table
    "as it is": "as it is; offset by 1e6 as double",
    "offset by 1e6, stored as double": "as it is; offset by 1e6 as double",
    "a single training image": "a single training image, at three scales",
    "a single training image, scaled by 1e-4": "a single training image, at three scales",
    "a single training image, scaled by 1e4": "a single training image, at three scales",
}


def measure():
    base, scene = checkpoint(CAPTURE).gaussians, photographs(CAPTURE)
    return [run(name, make(base, scene)) for name, make in CASES.items()]


def run(name, case):
    config = clod.AdaptConfig(**case.settings)
    started = time.perf_counter()
    adapted = clod.adapt(case.base, add_pseudo_views(case.base, case.scene), config)
    seconds = time.perf_counter() - started
    result = clod.extract(case.base, adapted.gaussians, fingerprint="", config={}).apply(case.base)
    dials = sorted({1.0, config.max_sv**0.5, config.max_sv})
    views = case.scene.test
    (base_row,) = quality(case.base, views, 1.0)
    pictures = (clod.render(result, views[0].camera, s).image for s in dials)
    finite = all(bool(x.isfinite().all()) for x in (*pictures, *result.tensors().values()))
    rows = quality(result, views, dials)
    return {
        "case": name,
        "finite": finite,
        "base_psnr": base_row["psnr"],
        "rows": rows,
        "holds": finite and rows[0]["psnr"] >= base_row["psnr"] - ALLOWED,
        "seconds": round(seconds, 1),
    }


def page_table(rows):
    """PSNR @ share kept at both ends of the dial, and which cases hold; of cases with one label
    the worst.
    """
    worst = {}
    for case in CASES:
        (row,) = (row for row in rows if row["case"] == case)
        label = TOGETHER.get(case, case)
        worst[label] = min(worst.get(label, row), row, key=lambda row: row["rows"][0]["psnr"])
    lines = []
    for label, row in worst.items():
        ends = (row["rows"][0], row["rows"][-1])
        cells = [f"{end['psnr']:.2f} @ {end['kept_share']:.0%}" for end in ends]
        passes = "yes" if row["holds"] else "**no**"
        lines.append([label, f"{row['base_psnr']:.2f}", *cells, passes])
    return Table(["scene", "base", "s = 1", "far end", "passes"], lines, rows)
