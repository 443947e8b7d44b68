"""Camera paths of the demo: smooth, both far from and close to the surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from city import look_at
from clod_adapter.cameras import Camera

import numpy as np

FIELD_OF_VIEW = 68.0  # degrees, across the width


@dataclass(frozen=True)
class CameraPath:
    """One path: `pose` returns eye and target at a time in 0..1, `share` is its relative number of views."""

    pose: Callable[[float], tuple[np.ndarray, np.ndarray]]
    share: int


def around_room(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Along the walls, looking across the middle."""
    a = 2 * np.pi * t
    eye = np.array([2.4 * np.sin(a), -1.65 + 0.2 * np.sin(2 * a), 4 - 3.35 * np.cos(a)])
    return eye, np.array([-0.5 * np.sin(a), -1.2, 4 + 0.6 * np.cos(a)])


def walk_in(t: float) -> tuple[np.ndarray, np.ndarray]:
    """From the entrance past the middle plinth up to the far wall's picture."""
    return np.array([0.95 * np.sin(np.pi * t), -1.55, 0.8 + 5.4 * t]), np.array([0.0, -1.5, 8.0])


def past_left_wall(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Past the pictures of the left wall, 1.35 m away."""
    z = 0.9 + 6.2 * t
    return np.array([-1.65, -1.55 + 0.12 * np.sin(4 * np.pi * t), z]), np.array([-3.0, -1.5, z + 0.15])


def past_right_wall(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Past the pictures of the right wall, towards the entrance."""
    z = 7.1 - 6.2 * t
    return np.array([1.65, -1.55 + 0.12 * np.sin(4 * np.pi * t), z]), np.array([3.0, -1.5, z - 0.15])


def around_plinth(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Around the glossy ball in the middle, close to it."""
    a = 2 * np.pi * t
    eye = np.array([1.15 * np.sin(a), -1.55 + 0.15 * np.sin(2 * a), 4 - 1.15 * np.cos(a)])
    return eye, np.array([0.0, -1.1, 4.0])


PATHS = (
    CameraPath(around_room, 20), CameraPath(walk_in, 9), CameraPath(past_left_wall, 10),
    CameraPath(past_right_wall, 11), CameraPath(around_plinth, 14),
)  # fmt: skip


def path_cameras(width: int, height: int, count: int) -> list[Camera]:
    """`count` cameras named from ``view_000.webp`` on, evenly spaced in time along each path in turn."""
    shares = np.array([path.share for path in PATHS])
    ends = np.rint(count * np.cumsum(shares) / shares.sum()).astype(int)
    poses = []
    for path, views in zip(PATHS, np.diff(ends, prepend=0), strict=True):
        poses += [path.pose((k + 0.5) / views) for k in range(views)]
    return [
        look_at(eye, target, width, height, f"view_{k:03d}.webp", FIELD_OF_VIEW)
        for k, (eye, target) in enumerate(poses)
    ]
