"""Photographs and their COLMAP models, shared by the tests of readers."""

import json
import os

import numpy as np
import pycolmap
import torch
from PIL import Image

from clod_adapter.cameras import Camera, intrinsics
from models import write_model

SIZE = {"width": 160, "height": 120}
# intrinsics of a transforms file
INTRINSICS = {"fl_x": 30.0, "fl_y": 31.0, "cx": 19.25, "cy": 15.5, "w": 40, "h": 30}
LENSES = {
    "SIMPLE_RADIAL": [140, 82, 58, -0.12],
    "OPENCV": [140, 142, 82, 58, -0.15, 0.05, 0.004, -0.003],
    "FULL_OPENCV": [140, 142, 82, 58, -0.15, 0.05, 0.004, -0.003, 0.01, 0.02, 0.01, 0],
    "FOV": [140, 142, 82, 58, 0.5],
    "SIMPLE_FISHEYE": [100, 82, 58],
    "OPENCV_FISHEYE": [100, 102, 82, 58, 0.03, -0.01, 0.002, 0.001],
    "THIN_PRISM_FISHEYE": [100, 102, 82, 58, 0.03, -0.01, 0.001, 0.002, 0.01, 0.02, 0.001, 0.002],
}


def pose(seed):
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, [seed, -1, 2]
    return torch.from_numpy(viewmat).float()


def camera(seed, width=40, height=30, focal=35.5):
    K = intrinsics(focal, focal + 1, 19.25, 15.5)
    return Camera(pose(seed), K, width, height)


def pixels(seed, width=40, height=30):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def write_scene(folder, count=10):
    """A scene whose model lists its images in another order than their names."""
    cameras = [camera(i, focal=30.0 + i % 2) for i in range(count)]
    names = [f"sub/{count - i:03d}.png" for i in range(count)]
    write_model(folder, cameras, names)
    write_images(folder / "images", names)
    return cameras, names


def write_images(folder, names):
    """The ``pixels`` of 0, 1, 2, ... Names are UTF-8 on disk, whatever the locale."""
    for i, name in enumerate(names):
        path = folder / os.fsdecode(name.encode())
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels(i)).save(path)


def to_world(seed):
    """``pose(seed)`` as a transforms file has it: camera to world, OpenGL axes."""
    return (np.linalg.inv(pose(seed).double().numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()


def write_frames(folder, frames, file="transforms.json", **rest):
    folder.mkdir(exist_ok=True)
    (folder / file).write_text(json.dumps({**rest, "frames": frames}))
    return folder


def names_of(views):
    return [view.camera.name for view in views]


def views_of(scene):
    """Those for training and for testing, sorted by name."""
    return sorted((*scene.train, *scene.test), key=lambda view: view.camera.name)


def model_of(
    folder,
    kind,
    params,
    width=40,
    height=30,
    *,
    names=("a.png",),
    form="binary",
):
    """The folder of a COLMAP model whose cameras are all at the origin and see two points."""
    reconstruction = pycolmap.Reconstruction()
    lens = pycolmap.Camera(model=kind, params=params, camera_id=1, width=width, height=height)
    reconstruction.add_camera_with_trivial_rig(lens)
    for number, name in enumerate(names, start=1):
        keypoints = [pycolmap.Point2D(np.array([k, number], float)) for k in range(2)]
        image = pycolmap.Image(name=name, camera_id=1, image_id=number, points2D=keypoints)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for k in range(2):
        track = pycolmap.Track(
            [pycolmap.TrackElement(number, k) for number in range(1, len(names) + 1)]
        )
        reconstruction.add_point3D(np.array([k, 1, 5], float), track, np.zeros(3, np.uint8))
    target = folder / "sparse" / "0"
    target.mkdir(parents=True, exist_ok=True)
    getattr(reconstruction, f"write_{form}")(str(target))
    return target


def seen(camera):
    """``[H, W, 3]`` uint8: a smooth pattern on the plane z = 1, seen through the lens of a camera
    at the origin.
    """
    across, down = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    u, v = camera.cam_from_img(np.stack([across.ravel(), down.ravel()], axis=1)).T
    waves = [np.sin(5 * u + v), np.sin(5 * v - 2 * u), np.sin(4 * (u + v) + 1)]
    return (
        np.rint(127.5 + 120 * np.stack(waves, axis=1))
        .astype(np.uint8)
        .reshape(camera.height, camera.width, 3)
    )
