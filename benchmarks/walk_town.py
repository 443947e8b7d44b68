"""The town of walk.py: the path, the truth, the checkpoint, the adapted file, and its levels."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache

import clod_adapter as clod
from city import city, city_cameras, look_at, perturb
from city_surfaces import FACADE, PITCH, blocks, build
from clod_adapter.cli.shared.console import Console
from clod_adapter.config import FILTERS
from clod_adapter.equation.distances import euclidean, in_frustum, typical_distance
from common import CACHE, Row, commit, supersampled
from tuning import RATES, Tuning, tune

import numpy as np
import torch
from torch import Tensor

NEAREST, TIMES = 4.0, 100.0  # metres from the door at the first frame; the last one is so many times as far
EYE, RISE = 1.7, 30.0  # metres above the ground; degrees of elevation at the last frame


@dataclass(frozen=True, kw_only=True)
class Town:
    """What is trained; files in ``benchmarks/cache`` are named by a hash of it."""

    count: int = 300_000  # Gaussians
    width: int = 480
    height: int = 320
    photographs: int = 96
    samples: int = 3  # of the truth and of photographs, along each side of a pixel
    tuning: int = 400  # steps that the checkpoint is trained for
    iters: int | None = None  # steps of adapting; None: the default
    max_sv: float = 8.0
    lr_means: float = 3e-5  # of the checkpoint's training, times the extent of its cameras, which is 300 m

    @property
    def key(self) -> str:
        return hashlib.sha256(json.dumps(asdict(self)).encode()).hexdigest()[:10]

    @lru_cache(maxsize=1)  # noqa: B019
    def truth(self) -> clod.Gaussians:
        return city(self.count).replace(screen_filter=FILTERS["on"])

    def cameras(self) -> list[clod.Camera]:
        """Of the photographs: two thirds in the streets and from the air, a third from all sides as far as the walk."""
        views, random = self.photographs // 3, np.random.default_rng(2)
        found = city_cameras(2 * views, self.width, self.height, where="mixed", count=self.count)
        for k in range(views):
            turn, pitch = random.uniform(0, 2 * np.pi), math.radians(random.uniform(15, 40))
            off = math.exp(random.uniform(math.log(0.3), 0.1)) * NEAREST * TIMES
            level = off * math.cos(pitch)
            eye = np.array([level * math.cos(turn), -off * math.sin(pitch), level * math.sin(turn)])
            found.append(look_at(eye, np.array([0.0, -5.0, 0.0]), self.width, self.height, f"far_{k:04d}.png"))
        return found

    def photograph(self, camera: clod.Camera) -> clod.View:
        """The truth: ``samples`` by ``samples`` pixels of the whole, unperturbed city averaged to one."""
        return clod.View(camera, supersampled(self.truth(), camera, self.samples))

    def scene(self) -> clod.Scene:
        views = []
        with Console().meter("photographs") as meter:
            for k, camera in enumerate(self.cameras()):
                views.append(self.photograph(camera))
                meter.update((k + 1) / self.photographs)
        return clod.Scene(tuple(views), ())

    def path(self, frames: int) -> list[clod.Camera]:
        """Cameras from a doorstep along the middle of its street, up and away, at distances of equal ratio."""
        door, street = doorstep(self.count)
        return [
            look_at(door + away(d, street - door[0]), door, self.width, self.height, f"{d:.4g} m")
            for d in distances(frames)
        ]


def distances(frames: int) -> list[float]:
    """From the door, metres."""
    return [NEAREST * TIMES ** (k / (frames - 1)) for k in range(frames)]


def doorstep(count: int) -> tuple[np.ndarray, float]:
    """``[3]`` a door in the middle of the town, and x of the middle of its street, which runs along z."""
    n = blocks(count)
    surfaces, street = build(count, np.random.default_rng(0)), (math.ceil(n / 2) - n / 2) * PITCH[0]
    middle = surfaces.origin + (surfaces.u + surfaces.v) / 2
    off = np.hypot(middle[:, 0] - street, middle[:, 2])
    wall = (surfaces.kind == FACADE) & (surfaces.normal[:, 0] > 0.9) & (surfaces.origin[:, 1] == 0)
    chosen = int(np.where(wall & (middle[:, 0] < street), off, np.inf).argmin())
    return np.array([middle[chosen, 0], -EYE, middle[chosen, 2]]), street


def away(distance: float, across: float) -> np.ndarray:
    """``[3]`` from the door to the eye: into the street, whose middle is ``across`` metres away, along it, and up."""
    share = math.log(distance / NEAREST) / math.log(TIMES)
    up, side = distance * math.sin(math.radians(RISE * share)), min(0.8 * distance, across)
    return np.array([side, -up, -math.sqrt(distance**2 - up**2 - side**2)])


def checkpoint(town: Town, scene: clod.Scene | None = None) -> clod.Checkpoint:
    """The perturbed city, trained on the photographs as 3DGS with antialiasing trains, without densification."""
    path = CACHE / f"walk-{town.key}-base.ply"
    if not path.exists():
        start = perturb(city(town.count)).replace(screen_filter=FILTERS["on"])
        with Console().meter("checkpoint") as meter:
            rates = RATES | {"means": town.lr_means}
            found = tune(start, (scene or town.scene()).train, Tuning(iters=town.tuning, rates=rates), meter.update)
        CACHE.mkdir(parents=True, exist_ok=True)
        clod.save(path, found.gaussians)
    return clod.load(path)


def adapted(town: Town, target: str = "count") -> tuple[clod.Gaussians, Row]:
    """The checkpoint adapted to the photographs as ``clod-adapt`` does, with a plan; and when, in how many seconds."""
    path = CACHE / f"walk-{town.key}-{target}.ply"
    about = path.with_suffix(".json")
    if not (path.exists() and about.exists()):
        scene, at = town.scene(), commit()
        base = checkpoint(town, scene)
        config = clod.AdaptConfig(iters=town.iters, max_sv=town.max_sv, target=target)
        plan = clod.make_plan(base.gaussians, scene, config)
        with Console().meter("adapting") as meter:
            result = plan.adapt(scene, lambda now: meter.update(now.share, f"loss {now.loss or 0:.4f}"))
        clod.save(path, plan.whole(base.gaussians, result.gaussians), base)
        seconds = round(sum(plan.seconds.values()) + result.seconds, 1)
        about.write_text(json.dumps({"commit": at, "seconds": seconds, "share": plan.config.share}), "utf-8")
    return clod.load(path).gaussians, json.loads(about.read_text("utf-8"))


def held(model: clod.Gaussians, path: Sequence[clod.Camera], budget: float) -> list[float]:
    """The dial value of each frame with which at most ``budget`` Gaussians are in view, within [1, max_sv].

    A viewer holds milliseconds instead: it chooses the dial value of a frame by the times of earlier ones.
    """
    assert model.attenuation is not None
    lean, found = model.without_bands(0), []
    for camera in path:
        try:
            shown = lean.select(in_frustum(lean.means, camera))
            found.append(clod.dial_for(shown, keep=budget, cameras=[camera]).virtual_scale)
        except clod.ClodError:
            found.append(model.attenuation.max_sv)
    return found


class Levels:
    """Levels of detail of the town, of which each block of houses shows one at a time.

    Args:
        levels: from fine to coarse; coarser ones may have moved Gaussians.
        town: whose blocks they are. What surrounds the town belongs to the nearest block.
    """

    def __init__(self, levels: Sequence[clod.Gaussians], town: Town) -> None:
        self.levels, self.cells = levels, [block_of(each.means, town.count) for each in levels]
        self.drawn = lru_cache(maxsize=3)(self._drawn)

    def _drawn(self, chosen: tuple[int, ...]) -> clod.Gaussians:
        """The Gaussians of the ``chosen`` level of each block."""
        wanted = torch.tensor(chosen)
        places = enumerate(zip(self.levels, self.cells, strict=True))
        parts = [level.select(wanted[cell] == k) for k, (level, cell) in places]
        names = parts[0].tensors()
        return parts[0].replace(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


def block_of(means: Tensor, count: int) -> Tensor:
    """``[N]`` the block of houses that each centre lies in, or the nearest one."""
    n = blocks(count)
    x, z = ((means[:, axis] / PITCH[axis // 2] + n / 2).floor().clamp(0, n - 1).long() for axis in (0, 2))
    return n * x + z


def choose(
    model: clod.Gaussians, town: Town, path: Sequence[clod.Camera], dials: Sequence[float]
) -> list[tuple[int, ...]]:
    """The level of each block in each frame: 0, or k + 1 for the one baked at ``dials[k]``, powers of 2.

    A file baked at s for the photographs' cameras has what the dial shows at s = 1 from s times the typical distance.
    So a block whose Gaussians are, in the geometric mean, t times their typical distances away shows the level whose s
    is nearest to t in ratio: each level is drawn over the octave in the middle of which the dial shows the same. Below
    ``t = sqrt(1/2)`` it is the checkpoint itself.
    """
    assert model.attenuation is not None
    typical = typical_distance(model.means, town.cameras(), model.attenuation)
    cell, found = block_of(model.means, town.count), []
    for camera in path:
        octaves = (euclidean(model.means, camera.position.to(model.means)) / typical).log2()
        mean = cell.bincount(octaves.double()) / cell.bincount()
        found.append(tuple((mean.round() + 1).clamp(0, len(dials)).long().tolist()))
    return found
