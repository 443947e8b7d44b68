"""A synthetic city of any number of Gaussians: streets, houses, trees, cars, fields and a sky.

It replaces captures that are too large for a repository. More Gaussians make a larger city at the same density of about
5 per square metre of surface. Thin Gaussians cover the surfaces, a fifth of them as a coarser layer; colours vary from
one Gaussian to the next, and all SH degrees are used.

World axes: x right, y DOWN, z into the picture, in metres; the ground is y = 0.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import clod_adapter as clod
from city_points import FIELD, cover, facing, higher_degrees, shade, surround
from city_surfaces import PITCH, blocks, build, extent, joined
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.scene.colmap import write_model

import numpy as np
import torch
from PIL import Image

Where = Literal["near", "far", "mixed"]
FAR = (1500, 0.02, 30_000)  # Gaussians of fields and sky: at least, of all, at most
PERTURBED = {"means": 0.02, "log_scales": 0.15, "opacity_logits": 0.5, "sh0": 0.12}  # of a checkpoint, off the truth
BLUR = 0.1  # of a checkpoint: its Gaussians are larger than the truth by this, in logarithms


def city(count: int, *, seed: int = 0, sh_degree: int = 3) -> Gaussians:
    """``count`` Gaussians of a city, at least 1000, with SH of degree 0 to 4; the same ones for the same arguments."""
    if count < 1000:
        raise SystemExit(f"a city needs at least 1000 Gaussians, not {count}")
    random = np.random.default_rng(seed)
    far = surrounding(count)
    points = joined([cover(build(count, random), count - far, random), surround(far, count, random)])
    noise = random.standard_normal((count, 3), np.float32)
    low = points.kind >= FIELD
    flat = np.where(low, np.float32(0.7), np.float32(0.5)) * points.spacing
    flat[: count - far : 5] *= 2.2  # the coarser layer
    log_scales = np.log(np.stack([flat, flat, 0.08 * flat], axis=1)) + 0.15 * noise
    logits = np.where(low, 3.0, 2.6 + 1.2 * noise[:, 0])
    shaded = shade(points, random)
    return Gaussians(
        means=torch.from_numpy(points.position),
        quats=torch.from_numpy(facing(points.normal, random)),
        log_scales=torch.from_numpy(log_scales.astype(np.float32)),
        opacity_logits=torch.from_numpy(logits.astype(np.float32)),
        sh0=torch.from_numpy((shaded - 0.5) / np.float32(SH_C0))[:, None],
        shN=torch.from_numpy(higher_degrees(points, shaded, sh_degree, random)),
    )


def surrounding(count: int) -> int:
    """Gaussians of fields and sky in a city of ``count``; they are its last ones."""
    least, share, most = FAR
    return min(max(round(share * count), min(least, count // 5)), most)


def city_cameras(
    n: int, width: int, height: int, *, where: Where = "mixed", count: int, seed: int = 0
) -> list[clod.Camera]:
    """``n`` cameras in a city of ``count`` Gaussians, named ``view_0000.png`` on.

    Args:
        where: "near": in the streets, at eye height and a little above; "far": from the air, looking down on the city
            at about 40 degrees, from all sides; "mixed": the two in turn.
    """
    random = np.random.default_rng(seed + 1)
    cameras = []
    for k in range(n):
        close = where == "near" or (where == "mixed" and k % 2 == 0)
        eye, target = (in_street if close else in_air)(count, random)
        cameras.append(look_at(eye, target, width, height, f"view_{k:04d}.png"))
    return cameras


def in_street(count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target of a camera on a street, looking along it more than across."""
    n, axis = blocks(count), int(random.integers(2))
    street = random.integers(0, n + 1) if n < 3 else random.integers(1, n)
    eye, ahead = np.zeros(2), np.zeros(2)
    eye[axis] = street * PITCH[axis] - n * PITCH[axis] / 2 + random.uniform(-2, 2)
    eye[1 - axis] = random.uniform(-0.45, 0.45) * n * PITCH[1 - axis]
    ahead[1 - axis] = -np.sign(eye[1 - axis])
    turn = math.radians(random.uniform(-25, 25))
    ahead = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ ahead
    up = random.uniform(1.7, 4.5)
    target = np.array([eye[0] + 20 * ahead[0], -up - random.uniform(0, 5), eye[1] + 20 * ahead[1]])
    return np.array([eye[0], -up, eye[1]]), target


def in_air(count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target of a camera above, a share of the city's size away."""
    size, turn = extent(count), random.uniform(0, 2 * np.pi)
    aim = random.uniform(-0.2, 0.2, 2) * size
    away, pitch = random.uniform(0.55, 1.1) * float(size.max()), math.radians(random.uniform(28, 50))
    level = away * math.cos(pitch)
    eye = np.array([
        aim[0] + level * math.cos(turn), -max(away * math.sin(pitch), 30.0), aim[1] + level * math.sin(turn)
    ])  # fmt: skip
    return eye, np.array([aim[0], -5.0, aim[1]])


def look_at(
    eye: np.ndarray, target: np.ndarray, width: int, height: int, name: str, field: float = 65.0
) -> clod.Camera:
    """An upright camera that has ``target`` in the middle of its image; ``field`` of view across the width, degrees."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    focal = width / 2 / math.tan(math.radians(field) / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return clod.Camera(torch.from_numpy(viewmat).float(), torch.from_numpy(K).float(), width, height, name)


def perturb(truth: Gaussians, seed: int = 0) -> Gaussians:
    """A checkpoint with the errors of training: the truth slightly blurred and displaced. In place; returned."""
    generator = torch.Generator().manual_seed(seed)
    size = truth.log_scales[:, :2].mean(1, keepdim=True).exp()
    for name, by in PERTURBED.items():
        values = getattr(truth, name)
        noise = torch.randn(values.shape, generator=generator).mul_(by)
        values += noise * size / 0.15 if name == "means" else noise
    truth.log_scales.add_(BLUR)
    return truth


def write_city(folder: str | Path, count: int, images: int, width: int, height: int, *, where: Where = "mixed") -> None:
    """Writes a perturbed checkpoint ``folder/city.ply`` and photographs of the truth as a COLMAP scene.

    The folder does not exist or is empty; it appears when everything in it is complete.
    """
    truth = city(count)
    cameras = city_cameras(images, width, height, where=where, count=count)
    with atomic_path(folder) as part:
        (part / "images").mkdir(parents=True)
        for camera in cameras:
            with torch.no_grad():
                Image.fromarray(clod.render(truth, camera).pixels.numpy()).save(part / "images" / camera.name)
        some = np.linspace(0, count - surrounding(count), 2000, endpoint=False).astype(np.int64)
        colors = ((0.5 + SH_C0 * truth.sh0[some, 0].numpy()).clip(0, 1) * 255).astype(np.uint8)
        write_model(part, cameras, [camera.name for camera in cameras], truth.means[some].numpy(), colors)
        clod.save(part / "city.ply", perturb(truth))
