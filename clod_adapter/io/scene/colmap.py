"""COLMAP models: posed images and points; damaged ones are refused before COLMAP reads them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from clod_adapter.errors import ClodError, refused_if_damaged
from clod_adapter.io.file_formats import read_bytes, refuse_long_numbers
from clod_adapter.io.scene.folder import find_cameras, name_parts
from clod_adapter.origin import NOWHERE

try:
    import pycolmap
except ModuleNotFoundError as error:
    fix = "pip install pycolmap; on arm64 Linux conda install -c conda-forge pycolmap"
    raise ClodError(f"cameras and photographs are read with pycolmap, which is not installed: {fix}") from error

TEST_EVERY = 8  # one view in this many is held out
HUGE = 1e9  # world units and pixels; larger values are damage, and may not fit float32


@dataclass(frozen=True)
class PosedImage:
    """A photograph's name, pose and camera."""

    name: str  # its path in the folder of photographs, parts joined by /
    viewmat: np.ndarray  # ``[4, 4]`` float64, world to camera, OpenCV axes
    camera: pycolmap.Camera  # any of COLMAP's perspective models; pixel centres lie at +0.5
    held_out: bool | None = None  # whether the scene marks it for testing; None where the scene marks none

    @property
    def is_pinhole(self) -> bool:
        """Whether it has no distortion, or only coefficients of 0."""
        return self.camera.is_perspective_pinhole() and self.camera.is_undistorted()

    def relative_to(self, origin: Sequence[float]) -> PosedImage:
        """In a world with its origin at ``origin [3]``; in float64, as float32 lacks digits far from 0."""
        viewmat = self.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ np.asarray(origin, np.float64)
        return replace(self, viewmat=viewmat)


def held_out(images: Sequence[PosedImage], test_every: int) -> set[str]:
    """Names of the test images: those that the scene marks, else the 0th and every ``test_every``-th of several."""
    if any(image.held_out is not None for image in images):
        return {image.name for image in images if image.held_out}
    return {image.name for image in images[::test_every]} if len(images) > 1 else set()


def check_posed(image: PosedImage, source: Path) -> PosedImage:
    """The image; refuses a camera or pose that is not finite, too large, or cannot become a pinhole."""
    camera = image.camera
    if not camera.is_perspective_pinhole() and not camera.is_perspective_fisheye():
        what = f"has camera model {camera.model_name}, no perspective camera; cut perspective views from it first"
        raise ClodError(f"{source}: image {image.name!r} {what}")
    lengths = [camera.focal_length_x, camera.focal_length_y, camera.width, camera.height]
    numbers = np.abs([*image.viewmat.ravel(), *camera.params, *lengths])
    if not (numbers < HUGE).all() or min(lengths) <= 0:  # a comparison with NaN is false
        raise ClodError(f"{source}: image {image.name!r} has a camera or pose that is not usable; export it again")
    return image


def read_colmap(model: Path) -> tuple[list[PosedImage], list[str]]:
    """The registered images of a model, sorted by name, and notes."""
    _check_records(model)
    with refused_if_damaged(model, "COLMAP cannot read this model"):
        reconstruction = pycolmap.Reconstruction(str(model))
        images = sorted(reconstruction.images.values(), key=lambda image: image.name)
        for image in images:
            name_parts(image.name, model)
        posed = [_posed_image(model, image) for image in images if image.has_pose]
    if not posed:
        raise ClodError(f"{model}: the model has no registered image; run COLMAP's mapper again")
    unposed = len(images) - len(posed)
    return posed, [f"{unposed} images of the model have no pose and are left out"] if unposed else []


def load_points(folder: str | Path, origin: Sequence[float] = NOWHERE) -> torch.Tensor:
    """``[M, 3]`` float64, the points of the scene's COLMAP model less ``origin``; none without a model."""
    model = find_cameras(Path(folder))
    points = pycolmap.Reconstruction(str(model)).points3D.values() if model.is_dir() else ()
    return torch.from_numpy(np.array([point.xyz for point in points], np.float64).reshape(-1, 3) - origin)


def _posed_image(model: Path, image: pycolmap.Image) -> PosedImage:
    assert image.camera is not None  # a Reconstruction gives every image its camera
    pose = image.cam_from_world()
    viewmat = np.vstack([pose.matrix(), [0, 0, 0, 1]])
    if hasattr(pose, "rotation") and not np.linalg.norm(pose.rotation.quat) > 0.5:
        viewmat[:3, :3] = np.nan  # pycolmap takes a quaternion of no length for no rotation
    # A copy, as the image's own is part of the whole reconstruction and keeps it in memory.
    return check_posed(PosedImage(image.name, viewmat, copy(image.camera)), model)


def _check_records(model: Path) -> None:
    """Refuses long numbers and cut binary records, as COLMAP reads past the end of these until memory runs out."""
    for name, after in _RECORDS.items():
        path = model / name
        if (text := path.with_suffix(".txt")).exists():
            refuse_long_numbers(text, read_bytes(text))
        if not path.exists():
            continue
        data, at = read_bytes(path), 8
        with refused_if_damaged(path, "is truncated or damaged", "copy or export the model again"):
            for _ in range(_count(data, 0)):
                at = after(data, at)
            if at > len(data):
                raise ValueError(f"its records end at byte {at} of {len(data)}")


def _count(data: bytes, at: int) -> int:
    return struct.unpack_from("<Q", data, at)[0]


def _camera_end(data: bytes, at: int) -> int:
    model = pycolmap.CameraModelId(struct.unpack_from("<i", data, at + 4)[0])
    parameters = pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params  # ValueError: no such model
    return at + 24 + 8 * len(parameters)  # id, model, width, height, parameters


def _rig_end(data: bytes, at: int) -> int:
    sensors = struct.unpack_from("<I", data, at + 4)[0]
    at += 16 if sensors else 8  # id, count, the reference sensor
    for _ in range(sensors - 1):
        at += 65 if struct.unpack_from("<?", data, at + 8)[0] else 9  # sensor, whether it has a pose, the pose
    return at


# Where the record that starts at a position ends, by file.
_RECORDS = {
    "cameras.bin": _camera_end,
    "rigs.bin": _rig_end,
    # id, rotation, translation, camera id, name, keypoints
    "images.bin": lambda data, at: (end := data.index(b"\0", at + 64) + 1) + 8 + 24 * _count(data, end),
    # id, position, colour, error, track
    "points3D.bin": lambda data, at: at + 51 + 8 * _count(data, at + 43),
    # id, rig id, rotation, translation, members (the count has 32 bits here)
    "frames.bin": lambda data, at: at + 68 + 16 * struct.unpack_from("<I", data, at + 64)[0],
}
