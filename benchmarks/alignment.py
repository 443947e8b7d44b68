"""The alignment check before training: which inputs it stops, which frame it guesses, and its CPU seconds.

The inputs are checkpoints of the shared captures with their own photographs, with cameras transformed as other tools
transform them, with another scene's checkpoint and with another exposure; and checkpoints in the normalised frames of
gsplat's and nerfstudio's trainers. Each case adds a row to ``results/alignment.jsonl``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace

import clod_adapter as clod
from clod_adapter.alignment.check import check_alignment
from clod_adapter.alignment.search import guess_frame
from clod_adapter.io.scene.colmap import load_points
from common import append, arguments, capture, checkpoint, photographs

import numpy as np
import pycolmap
import torch
from torch import Tensor

SCENES = ("plush_half", "ci_banana", "bonsai146")
EYE = torch.eye(3, dtype=torch.float64)
BACKWARD = torch.diag(torch.tensor([1.0, -1, -1, 1]))
Case = tuple[str, clod.Gaussians, list[clod.View]]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", default=SCENES)
    names = parser.parse_args().scenes
    loaded = {name: checkpoint(name).gaussians for name in SCENES}
    for name in names:
        scene = photographs(name)
        views, points = [*scene.test, *scene.train], load_points(capture(name))
        check_alignment(loaded[name], views)  # compiled and warm
        others: list[Case] = [(f"the file of {other}", loaded[other], views) for other in SCENES if other != name]
        for case, gaussians, seen in [*cases(loaded[name], views, points), *others]:
            append("alignment.jsonl", {"scene": name, "case": case, **row(gaussians, seen, points)})


def row(gaussians: clod.Gaussians, views: list[clod.View], points: Tensor) -> dict[str, object]:
    """CPU seconds of all threads, which other work on the machine affects less."""
    began = time.process_time()
    found = check_alignment(gaussians, views)
    checked = time.process_time()
    guess = guess_frame(gaussians, views, found, points) if found.doubtful else None
    numbers = {key: round(value, 3) for key, value in found.as_dict().items()}
    return {
        "fits": found.fits and guess is None, **numbers, "guess": guess and guess.frame.description,
        "clear": guess and guess.clear,
        "guess_psnr": guess and round(guess.psnr, 2), "check_cpu_s": round(checked - began, 2),
        "guess_cpu_s": round(time.process_time() - checked, 2) if found.doubtful else None,
    }  # fmt: skip


def cases(base: clod.Gaussians, views: list[clod.View], points: Tensor) -> Iterator[Case]:
    yield "as it is", base, views
    yield "darker by a stop", base, [exposed(view, 0.5) for view in views]
    sparse = base.select(torch.arange(0, len(base), 2))
    yield "half the Gaussians, no harmonics", sparse.replace(shN=sparse.shN[:, :0]), views
    flip, z_up, mirror = EYE.clone(), EYE[[0, 2, 1]].clone(), EYE.clone()
    flip[1, 1] = flip[2, 2] = z_up[1, 2] = mirror[0, 0] = -1
    far = torch.tensor([20.0, -31, 13], dtype=torch.float64)
    none = torch.zeros(3, dtype=torch.float64)
    median = base.means.double().median(dim=0).values
    for case, scale, rotation, offset in [
        ("y and z negated", 1.0, flip, none), ("z up", 1.0, z_up, none), ("mirrored in x", 1.0, mirror, none),
        ("axes in turn", 1.0, EYE[[1, 2, 0]], none), ("9.7 times larger", 9.7, EYE, none),
        ("7.7 times smaller", 0.13, EYE, none), ("1.3 times larger", 1.3, EYE, none),
        ("1.05 times larger", 1.05, EYE, none), ("moved far", 1.0, EYE, far), ("moved", 1.0, EYE, far / 10),
        ("moved a little", 1.0, EYE, far / 100), ("recentred", 1.0, EYE, -median),
        ("3.3 times larger and moved", 3.3, EYE, far / 10),
    ]:  # fmt: skip
        yield case, base, [in_world(view, scale, rotation, offset) for view in views]
    yield "camera to world", base, [posed(view, torch.linalg.inv(view.camera.viewmat)) for view in views]
    yield "OpenGL's poses", base, [posed(view, BACKWARD @ view.camera.viewmat) for view in views]
    poses = np.stack([np.linalg.inv(view.camera.viewmat.double().numpy()) for view in views])
    yield "gsplat's frame", moved(base, gsplat(poses, points.numpy())), views
    for turn in (np.diag([1.0, 1, 1]), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])):
        yield "nerfstudio's frame", moved(base, nerfstudio(poses, turn)), views
    tilt = np.eye(4)
    tilt[:3, :3] = turning(np.array([1.0, 0, 0]), np.array([0.5, 0.5, 0.7]))
    yield "turned by 60 degrees", moved(base, tilt), views


def exposed(view: clod.View, gain: float) -> clod.View:
    return clod.View(view.camera, (view.image * gain).round().to(torch.uint8))


def posed(view: clod.View, viewmat: Tensor) -> clod.View:
    return clod.View(replace(view.camera, viewmat=viewmat.to(view.camera.viewmat)), view.image)


def in_world(view: clod.View, scale: float, rotation: Tensor, offset: Tensor) -> clod.View:
    """The view in a world where ``x' = scale rotation x + offset``."""
    viewmat = view.camera.viewmat.double()
    turned = viewmat[:3, :3] @ rotation.T
    out = torch.eye(4, dtype=torch.float64)
    out[:3, :3], out[:3, 3] = turned, scale * viewmat[:3, 3] - turned @ offset
    return posed(view, out)


def moved(base: clod.Gaussians, transform: np.ndarray) -> clod.Gaussians:
    """The Gaussians after a similarity, without harmonics, which would have to be turned too."""
    scale = np.linalg.det(transform[:3, :3]) ** (1 / 3)
    x, y, z, w = pycolmap.Rotation3d(transform[:3, :3] / scale).quat
    # The product of the turn and each rotation, as a matrix on wxyz.
    product = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float32)
    matrix = torch.from_numpy(transform).float()
    return base.replace(
        means=base.means @ matrix[:3, :3].T + matrix[:3, 3], quats=base.quats @ product.T,
        log_scales=base.log_scales + math.log(scale), shN=base.shN[:, :0],
    )  # fmt: skip


def similarity(rotation: np.ndarray, scale: float, offset: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = scale * rotation, scale * offset
    return out


def turning(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotation from one direction to another: two reflections."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    half = (a + b) / np.linalg.norm(a + b)
    return (2 * np.outer(half, half) - np.eye(3)) @ (2 * np.outer(a, a) - np.eye(3))


def gsplat(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """gsplat's example trainer with ``normalize_world_space``; poses are camera to world."""
    rotation = turning(-poses[:, :3, 1].mean(0), np.array([0.0, -1, 0]))
    centres, forward = poses[:, :3, 3] @ rotation.T, poses[:, :3, 2] @ rotation.T
    nearest = centres - np.einsum("vi,vi,vj->vj", forward, centres, forward)
    focus = np.median(nearest, axis=0)
    first = similarity(rotation, 1 / float(np.median(np.linalg.norm(centres - focus, axis=1))), -focus)
    placed = points @ first[:3, :3].T + first[:3, 3]
    middle = np.median(placed, axis=0)
    axes = np.linalg.svd(placed - placed.mean(0), full_matrices=False)[2]
    axes[0] *= np.linalg.det(axes)
    second = similarity(axes, 1.0, -axes @ middle)
    heights = (placed - middle) @ axes[2]
    upright = np.diag([1.0, -1, -1, 1]) if np.median(heights) > heights.mean() else np.eye(4)
    return upright @ second @ first


def nerfstudio(poses: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """nerfstudio's default ``auto_orient_and_center_poses`` and scaling, after a turn of COLMAP's world."""
    rotation = turning(turn @ -poses[:, :3, 1].mean(0), np.array([0.0, 0, 1])) @ turn
    centres = poses[:, :3, 3] @ rotation.T
    return similarity(rotation, 1 / np.abs(centres - centres.mean(0)).max(), -centres.mean(0))


if __name__ == "__main__":
    main()
