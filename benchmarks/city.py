"""A synthetic town of any number of Gaussians: a plain with houses on a grid, under a sky.

It replaces captures that are too large for a repository. More Gaussians make a larger town of the
same density, about five for each square metre of surface. World axes: x right, y DOWN, z into the
picture, in metres; the ground is y = 0.
"""

import math
from typing import Literal

import clod_adapter as clod
from clod_adapter.cameras import intrinsics
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.io.atomic import atomic_path
from models import write_photographs

import numpy as np
import torch

Where = Literal["near", "far", "mixed"]
PITCH = 24.0  # metres
HOUSE = 12.0  # metres
AREA = 1050.0  # square metres of surface of a lot
DENSITY = 5.0  # Gaussians on each square metre
SKY = 0.03  # share of the Gaussians
# of a checkpoint, off the truth
PERTURBED = {"means": 0.02, "log_scales": 0.15, "opacity_logits": 0.5, "sh0": 0.12}


def lots(count):
    """Houses along a side of the town."""
    return max(math.ceil(math.sqrt(count / (DENSITY * AREA))), 1)


def city(count):
    """``count`` Gaussians, at least 1000; always the same ones."""
    if count < 1000:
        raise SystemExit(f"a town needs at least 1000 Gaussians, not {count}")
    random = np.random.default_rng(0)
    far = round(SKY * count)
    size = lots(count) * PITCH
    points, normals, colours = surfaces(count - far, random)
    up = random.normal(size=(far, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    points = np.concatenate([points, 3 * size * up])
    normals = np.concatenate([normals, up])
    sky = np.array([0.5, 0.6, 0.65]) - 0.25 * up[:, 1:2] * [0.4, 0.7, 1]
    colours = np.concatenate([colours, sky])
    spacing = np.sqrt(lots(count) ** 2 * AREA / (count - far))
    flat = np.full(count, 0.7 * spacing)
    flat[count - far :] = 1.3 * math.sqrt(4 * math.pi * (3 * size) ** 2 / far)
    noise = random.standard_normal((count, 3))
    log_scales = np.log(np.stack([flat, flat, 0.08 * flat], 1)) + 0.15 * noise
    higher = random.normal(scale=0.03, size=(count, 15, 3))
    logits = np.where(np.arange(count) < count - far, 2.6 + 1.2 * noise[:, 0], 3.0)
    sh0 = ((colours - 0.5) / SH_C0)[:, None]
    attributes = (points, facing(normals), log_scales, logits, sh0, higher)
    return Gaussians(*(torch.from_numpy(values).float() for values in attributes))


def surfaces(count, random):
    """Points, normals and colours on the plain and on the houses' walls and roofs."""
    side = lots(count)
    lot = random.integers(0, side**2, count)
    kind = random.random(count)
    along = random.uniform(-0.5, 0.5, (count, 2))
    height = random.uniform(6, 14, side**2)[lot]
    hue = random.uniform(0.35, 0.85, (side**2, 3))[lot]
    centre = PITCH * (np.stack([lot % side, lot // side], 1) - (side - 1) / 2)
    ground, roof = kind < 0.5, kind > 0.86
    turned = (4 * (kind - 0.5) / 0.36).astype(int).clip(0, 3)  # which of the four walls
    outward = np.stack([np.cos(turned * np.pi / 2), np.sin(turned * np.pi / 2)], 1).round()
    wall = HOUSE * (outward / 2 + along[:, :1] * outward[:, ::-1])
    upward = (ground | roof)[:, None]
    level = np.where(upward, np.where(ground, PITCH, HOUSE)[:, None] * along, wall)
    depth = np.where(ground, 0, np.where(roof, height, (along[:, 1] + 0.5) * height))
    points = np.insert(centre + level, 1, -depth, 1)
    normals = np.where(upward, [0.0, -1, 0], np.insert(outward, 1, 0, 1))
    pattern = 0.08 * np.sin(points @ np.array([[1.1, 0.3, 2.0], [2.3, 1.7, 0.4], [0.6, 2.9, 1.5]]))
    base = np.where(ground[:, None], [0.42, 0.44, 0.4], np.where(roof[:, None], 0.7 * hue, hue))
    colours = base + pattern + 0.03 * random.normal(size=(count, 3))
    return points, normals, colours.clip(0.02, 0.98)


def facing(normals):
    """Quaternions that turn z to the normals."""
    x, y, z = normals.T
    quats = np.stack([1 + z, -y, x, 0 * x], 1)
    quats[z < -0.999] = [0, 1, 0, 0]
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def city_cameras(n, width, height, *, where="mixed", count, seed=0):
    """``n`` cameras, named ``view_0000.png`` on: "near" in the streets, "far" in the air, or the
    two in turn.
    """
    random = np.random.default_rng(seed + 1)
    size = lots(count) * PITCH
    cameras = []
    for k in range(n):
        if where == "near" or (where == "mixed" and k % 2 == 0):
            street = PITCH * (random.integers(0, lots(count) + 1) - lots(count) / 2)
            eye = np.array([street, -random.uniform(1.7, 4.5), random.uniform(-0.45, 0.45) * size])
            turn = math.radians(random.uniform(-25, 25))
            target = eye + 20 * np.array(
                [math.sin(turn), -0.1, -math.copysign(math.cos(turn), eye[2])]
            )
        else:
            turn, pitch = random.uniform(0, 2 * np.pi), math.radians(random.uniform(28, 50))
            target = np.array([*random.uniform(-0.2, 0.2, 2) * size, 0])[[0, 2, 1]]
            away = random.uniform(0.6, 1.1) * max(size, 30)
            eye = target + away * direction(turn, pitch)
        cameras.append(look_at(eye, target, width, height, f"view_{k:04d}.png"))
    return cameras


def direction(turn, rise):
    """A unit vector, by radians about the vertical and above the ground."""
    level = math.cos(rise)
    return np.array([level * math.cos(turn), -math.sin(rise), level * math.sin(turn)])


def look_at(eye, target, width, height, name):
    """An upright camera with ``target`` in the middle of its image, and 65 degrees across it."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    focal = width / 2 / math.tan(math.radians(65) / 2)
    K = intrinsics(focal, focal, width / 2, height / 2)
    return clod.Camera(torch.from_numpy(viewmat).float(), K, width, height, name)


def perturb(truth):
    """A checkpoint with the errors of training: the truth slightly blurred and displaced. In place;
    returned.
    """
    generator = torch.Generator().manual_seed(0)
    size = truth.log_scales[:, :2].mean(1, keepdim=True).exp()
    for name, by in PERTURBED.items():
        values = getattr(truth, name)
        noise = torch.randn(values.shape, generator=generator).mul_(by)
        values += noise * size / 0.15 if name == "means" else noise
    truth.log_scales.add_(0.1)
    return truth


def write_city(folder, count, images, width, height):
    """Writes a perturbed checkpoint ``folder/city.ply`` and photographs of the truth as a COLMAP
    scene, whole.
    """
    truth, cameras = city(count), city_cameras(images, width, height, count=count)
    with atomic_path(folder) as part:
        with torch.no_grad():
            pictures = [clod.render(truth, camera).pixels.numpy() for camera in cameras]
        rows = np.linspace(0, count * (1 - SKY), 2000, endpoint=False).astype(np.int64)
        points = truth.means[rows].numpy()
        colours = ((0.5 + SH_C0 * truth.sh0[rows, 0].numpy()).clip(0, 1) * 255).astype(np.uint8)
        write_photographs(part, cameras, pictures, points, colours)
        clod.save(part / "city.ply", perturb(truth))
