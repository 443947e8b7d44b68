"""The scenes that the rasterizer is timed on: W1 and W2, synthetic rooms.

W1 and W2 are a room with spheres and boxes in it, its surfaces covered with small flat Gaussians of
mixed opacity, one in twenty large and faint. The yardstick makes the same ones: ``differences``
compares.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from clod_adapter.cameras import Camera, intrinsics
from clod_adapter.gaussians import SH_C0

import numpy as np
import torch
from torch import Tensor


class Size(NamedTuple):
    count: int  # Gaussians
    width: int
    height: int
    seed: int


SIZES = {"W1": Size(50_000, 480, 320, 1), "W2": Size(300_000, 960, 640, 2)}
FIELDS = ("means", "quats", "scales", "opacities", "sh")
Array = np.ndarray


@dataclass(frozen=True)
class Workload:
    """Activated float32 parameters, a camera, and the weights of the loss
    ``(image * weights).sum()``.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    camera: Camera
    weights: Tensor

    def parameters(self):
        """What a rasterizer takes, by name: views or copies, all contiguous."""
        fields = {name: getattr(self, name) for name in FIELDS[:-1]}
        return {
            **fields,
            "sh0": self.sh[:, :1].contiguous(),
            "shN": self.sh[:, 1:].contiguous(),
        }


def make(size):
    """A workload; the draws come in a fixed order, which the numbers depend on."""
    draw = np.random.default_rng(size.seed)
    count, width, height = size[:3]
    rotation, translation, focal = _pose(width)
    points = _surface_points(draw, count)
    depths = np.maximum((points @ rotation.T + translation)[:, 2], 0.3)
    pixels, opacities = _sizes_and_opacities(draw, count)
    quats = draw.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    sh = _colors(draw, points)
    weights = draw.normal(size=(height, width, 3)) / (height * width) * 100
    viewmat = np.block([[rotation, translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    K = intrinsics(focal, focal, width / 2, height / 2)
    return Workload(
        *map(_tensor, (points, quats, pixels * depths[:, None] / focal, opacities, sh)),
        Camera(_tensor(viewmat), K, width, height),
        _tensor(weights),
    )


def _tensor(array):
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def _pose(width):
    """Rotation and translation of the view matrix, and the focal length in pixels."""
    yaw, pitch = np.radians(6.0), np.radians(-4.0)
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array(
        [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    )
    rotation = about_x @ about_y
    translation = -rotation @ np.array([0.3, -0.2, -4.2])
    return rotation, translation, 0.5 * width / np.tan(np.radians(60) / 2)


def _surface_points(draw, count):
    """Points near the surfaces: back, left, right, floor and ceiling of a room, four spheres, two
    boxes.
    """
    kinds = draw.choice(7, count, p=[0.22, 0.10, 0.10, 0.12, 0.06, 0.28, 0.12])
    within = draw.uniform(-1, 1, (count, 3))
    points = within * [3, 2, 3]
    for kind, (axis, at) in enumerate([(2, 3), (0, -3), (0, 3), (1, 2), (1, -2)]):
        points[kinds == kind, axis] = at
    centres = np.array([[-1.2, 0.6, 0.2], [0.9, 0.2, -0.6], [0.1, -0.7, 1.2], [1.6, 1.1, 0.9]])
    radii = np.array([0.8, 0.6, 0.7, 0.5])
    directions = draw.normal(size=((kinds == 5).sum(), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    which = draw.integers(0, len(radii), len(directions))
    points[kinds == 5] = centres[which] + directions * radii[which, None]
    faces = within[kinds == 6]
    rows, axes = np.arange(len(faces)), draw.integers(0, 3, len(faces))
    faces[rows, axes] = np.sign(faces[rows, axes])
    which = draw.integers(0, 2, len(faces))
    centres = np.array([[-0.2, 1.3, -1.2], [-2.2, 0, 1.8]])
    halves = np.array([[0.5, 0.6, 0.4], [0.5, 1.2, 0.5]])
    points[kinds == 6] = centres[which] + faces * halves[which]
    return points + draw.normal(scale=0.015, size=points.shape)


def _sizes_and_opacities(draw, count):
    """Standard deviations in pixels, and opacities: many faint, some nearly opaque; one in twenty
    large and faint.
    """
    pixels = np.exp(
        np.log(1.2) + 0.5 * draw.normal(size=(count, 1)) + 0.35 * draw.normal(size=(count, 3))
    )
    pixels[:, 2] *= 0.25
    kinds = draw.random(count)
    faint, medium = 0.005 + 0.5 * draw.beta(0.9, 4, count), draw.beta(2, 2, count)
    opacities = np.where(kinds < 0.85, medium, draw.uniform(0.93, 0.999, count))
    opacities = np.where(kinds < 0.55, faint, opacities)
    large = draw.random(count) < 0.05
    sizes = draw.uniform(np.log(6), np.log(30), (large.sum(), 1))
    pixels[large] = np.exp(sizes + 0.3 * draw.normal(size=(len(sizes), 3)))
    opacities[large] = 0.02 + 0.3 * draw.beta(1, 3, len(sizes))
    return pixels, opacities


def _colors(draw, points):
    """Spherical harmonics of degree 3: waves of colour through the room, higher degrees at
    random.
    """
    waves = 0.35 * np.sin(points @ draw.normal(size=(3, 3)) * 1.7 + 1.0)
    base = 0.5 + waves + 0.08 * draw.normal(size=points.shape)
    sh = np.empty((len(points), 16, 3))
    sh[:, 0] = (base - 0.5) / SH_C0
    spread = np.repeat([0.10, 0.06, 0.04], [3, 5, 7])
    sh[:, 1:] = draw.normal(size=(len(points), 15, 3)) * spread[:, None]
    return sh


def differences(ours, theirs):
    """Names of the yardstick's arrays that are not ours bit for bit."""
    mine = {name: getattr(ours, name) for name in FIELDS} | {"G": ours.weights}
    mine |= {name: getattr(ours.camera, name) for name in ("viewmat", "K", "width", "height")}
    return [name for name, value in mine.items() if not np.array_equal(value, theirs[name])]
