"""What this package needs of pycolmap, in its names, where pycolmap has no wheel: COLMAP models in and out, cameras.

A model holds cameras, images and points; rigs and frames are not read, as each image holds its own pose. Written models
are of the form before rigs, which all versions of COLMAP read. Lenses are in ``colmap_lenses`` and
``colmap_undistortion``.

Source: COLMAP's documentation, "Output Format", and ``src/colmap/sensor/models.h``. Tests compare with pycolmap.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter.io.scene.colmap_lenses import MODELS, Lens
from clod_adapter.io.scene.colmap_undistortion import undistorted_camera, warp

__version__ = "plain-1"  # of the undistorted photographs that are kept


class CameraModelId(int):
    """COLMAP's number of a camera model.

    Raises:
        ValueError: there is no such model.
    """

    def __new__(cls, number: int) -> CameraModelId:
        if not 0 <= number < len(MODELS):
            raise ValueError(f"{number} is no valid CameraModelId")
        return super().__new__(cls, number)

    @property
    def name(self) -> str:
        return list(MODELS)[self]


class Camera(Lens):
    """A camera as pycolmap has it."""

    def __init__(self, model: str, params: Any, width: int, height: int, camera_id: int = 1) -> None:
        if model not in MODELS:
            raise ValueError(f"camera model {model[:40]!r} does not exist")
        if len(params) != MODELS[model].parameters:
            raise ValueError(f"a camera of model {model} has {MODELS[model].parameters} parameters, not {len(params)}")
        super().__init__(model, width, height, np.array(params, np.float64))
        self.camera_id = camera_id

    @classmethod
    def create_from_model_id(
        cls, camera_id: int, model: CameraModelId, focal: float, width: int, height: int
    ) -> Camera:
        kind = MODELS[model.name]
        params = np.zeros(kind.parameters)
        params[: kind.focals] = focal
        return cls(model.name, params, width, height, camera_id)


@dataclass
class Rigid3d:
    """``[3, 4]`` float64: a rotation and a translation."""

    values: np.ndarray = field(default_factory=lambda: np.eye(4)[:3])

    def matrix(self) -> np.ndarray:
        return self.values


@dataclass
class Image:
    name: str
    camera_id: int
    image_id: int
    camera: Camera | None = None
    pose: Rigid3d | None = None
    has_pose = True

    def cam_from_world(self) -> Rigid3d:
        assert self.pose is not None
        return self.pose


class Track:
    """The images that see a point; none is kept."""


@dataclass(frozen=True)
class Point3D:
    xyz: np.ndarray
    color: np.ndarray


class Reconstruction:
    """A model, read from the folder ``path`` (binary, or else text) if one is given.

    Raises:
        ValueError, KeyError or IndexError: a file is damaged, or an image has no camera.
    """

    def __init__(self, path: str | None = None) -> None:
        self.cameras: dict[int, Camera] = {}
        self.images: dict[int, Image] = {}
        self.points3D: dict[int, Point3D] = {}
        if path is None:
            return
        folder = Path(path)
        read = _read_binary if (folder / "cameras.bin").is_file() else _read_text
        for record in read(folder):
            if isinstance(record, Camera):
                self.cameras[record.camera_id] = record
            elif isinstance(record, Image):
                record.camera = self.cameras[record.camera_id]
                self.images[record.image_id] = record
            else:
                self.points3D[len(self.points3D) + 1] = record

    def add_camera_with_trivial_rig(self, camera: Camera) -> None:
        self.cameras[camera.camera_id] = camera

    def add_image_with_trivial_frame(self, image: Image, pose: Any) -> None:
        image.camera, image.pose = self.cameras[image.camera_id], pose if isinstance(pose, Rigid3d) else Rigid3d(pose)
        self.images[image.image_id] = image

    def add_point3D(self, xyz: np.ndarray, track: Track, color: np.ndarray) -> None:
        self.points3D[len(self.points3D) + 1] = Point3D(xyz, color)

    def write_binary(self, folder: str) -> None:
        numbers = {name: number for number, name in enumerate(MODELS)}
        cameras = [
            struct.pack("<IiQQ", c.camera_id, numbers[c.model_name], c.width, c.height)
            + c.params.astype("<f8").tobytes()
            for c in self.cameras.values()
        ]
        images = [
            struct.pack("<I7dI", i.image_id, *_quaternion(i), *i.cam_from_world().matrix()[:, 3], i.camera_id)
            + i.name.encode() + b"\0" + bytes(8)
            for i in self.images.values()
        ]  # fmt: skip
        points = [
            struct.pack("<Q3d3BdQ", number, *point.xyz, *point.color, -1.0, 0)
            for number, point in self.points3D.items()
        ]
        for name, records in {"cameras": cameras, "images": images, "points3D": points}.items():
            (Path(folder) / f"{name}.bin").write_bytes(struct.pack("<Q", len(records)) + b"".join(records))


class UndistortCameraOptions:
    """COLMAP's defaults: no blank pixels, scaled by 0.2 to 2."""


@dataclass(frozen=True)
class Bitmap:
    values: np.ndarray

    @classmethod
    def from_array(cls, values: np.ndarray) -> Bitmap:
        return cls(values)

    def to_array(self) -> np.ndarray:
        return self.values


def undistort_image(options: UndistortCameraOptions, image: Bitmap, camera: Camera) -> tuple[Bitmap, Camera]:
    """The photograph as a pinhole camera of the same focal length has it, and that camera.

    Raises:
        ValueError: the lens leaves no picture.
    """
    pinhole = undistorted_camera(camera)
    return Bitmap(warp(image.values, camera, pinhole)), Camera("PINHOLE", pinhole.params, pinhole.width, pinhole.height)


def _read_binary(folder: Path) -> Iterator[Camera | Image | Point3D]:
    try:
        data, at = (folder / "cameras.bin").read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            camera_id, number, width, height = struct.unpack_from("<IiQQ", data, at)
            model = CameraModelId(number).name
            params = np.frombuffer(data, "<f8", MODELS[model].parameters, at + 24)
            yield Camera(model, params, width, height, camera_id)
            at += 24 + params.nbytes
        data, at = (folder / "images.bin").read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            image_id, *pose, camera_id = struct.unpack_from("<I7dI", data, at)
            end = data.index(b"\0", at + 64)
            yield Image(data[at + 64 : end].decode(), camera_id, image_id, pose=_pose(pose))
            at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
        data, at = (folder / "points3D.bin").read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            yield Point3D(np.array(struct.unpack_from("<3d", data, at + 8)), np.frombuffer(data, np.uint8, 3, at + 32))
            at += 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
    except struct.error as error:
        raise ValueError(str(error)) from error


def _read_text(folder: Path) -> Iterator[Camera | Image | Point3D]:
    for line in _lines(folder / "cameras.txt"):
        camera_id, model, width, height, *params = line.split()
        yield Camera(model, [float(value) for value in params], int(width), int(height), int(camera_id))
    lines = _lines(folder / "images.txt", blank=True)
    for line in lines:
        image_id, *pose, camera_id, name = line.split(maxsplit=9)
        yield Image(name, int(camera_id), int(image_id), pose=_pose([float(value) for value in pose]))
        next(lines, "")  # the keypoints of it, perhaps none
    for line in _lines(folder / "points3D.txt"):
        values = line.split()
        yield Point3D(np.array(values[1:4], np.float64), np.array(values[4:7], np.uint8))


def _lines(path: Path, *, blank: bool = False) -> Iterator[str]:
    """The lines without comments; blank ones, after the first that is none, only if they are asked for."""
    seen = False
    for line in path.read_bytes().decode().splitlines():
        seen = seen or bool(line.strip()) and not line.startswith("#")
        if not line.startswith("#") and (line.strip() or (blank and seen)):
            yield line.strip()


def _pose(values: Any) -> Rigid3d:
    """Of a quaternion wxyz, of any length, and a translation.

    Raises:
        ValueError: they are not seven numbers.
    """
    if len(values) != 7:
        raise ValueError(f"a pose has 7 numbers, not {len(values)}")
    q = np.array(values[:4])
    with np.errstate(all="ignore"):  # a pose of no length comes out as NaN, which is refused
        w, x, y, z = q / np.linalg.norm(q)
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return Rigid3d(np.column_stack([rotation, values[4:]]))


def _quaternion(image: Image) -> list[float]:
    """wxyz of the image's rotation."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(image.cam_from_world().matrix()[:, :3]).as_quat()
    return [w, x, y, z]
