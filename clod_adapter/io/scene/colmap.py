"""COLMAP models: posed images and points, from binary or text files.

Source: COLMAP's documentation, "Output Format".
"""

from __future__ import annotations

import re
import struct
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from clod_adapter._support.text import as_text
from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.io.file_formats import read_bytes, reject_long_numbers
from clod_adapter.io.scene.folder import find_cameras, form_of, plain_name
from clod_adapter.origin import NOWHERE

try:
    import pycolmap
except ModuleNotFoundError as error:
    fix = "pip install pycolmap; on arm64 Linux conda install -c conda-forge pycolmap"
    raise ClodError(
        f"cameras and photographs are read with pycolmap, which is not installed: {fix}"
    ) from error

TEST_EVERY = 8  # one view in this many is held out
DAMAGED = "is truncated or damaged"
START = 4096  # bytes of a text file that hold its header
# beside a model, the names of its test images, as Inria's and Hierarchical-3DGS's code has it
SPLIT = "test.txt"
HUGE = 1e9  # world units and pixels; larger values are damage, and may not fit float32


Image = tuple[str, list[float], int]  # as a model's file has it


@dataclass(frozen=True)
class PosedImage:
    """A photograph's name, pose and camera."""

    name: str  # its path in the folder of photographs, parts joined by /
    viewmat: np.ndarray  # ``[4, 4]`` float64, world to camera, OpenCV axes
    camera: pycolmap.Camera  # any of COLMAP's perspective models; pixel centres lie at +0.5
    # whether the scene marks it for testing; None where the scene marks none
    held_out: bool | None = None

    @property
    def is_pinhole(self) -> bool:
        """Whether it has no distortion, or only coefficients of 0."""
        return self.camera.is_perspective_pinhole() and self.camera.is_undistorted()

    def relative_to(self, origin: Sequence[float]) -> PosedImage:
        """The image in a world with its origin at ``origin [3]``; in float64, as float32 lacks
        digits far from 0.
        """
        viewmat = self.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ np.asarray(origin, np.float64)
        return replace(self, viewmat=viewmat)


def held_out(images: Sequence[PosedImage], test_every: int) -> set[str]:
    """Names of the test images: those that the scene marks, else the 0th and every
    ``test_every``-th of several.
    """
    if any(image.held_out is not None for image in images):
        return {image.name for image in images if image.held_out}
    return {image.name for image in images[::test_every]} if len(images) > 1 else set()


def marked(
    images: list[PosedImage], entries: Iterable[str], source: str, *, training: bool = False
) -> tuple[list[PosedImage], list[str]]:
    """The images, those held out that a list has (``training``: has not), and notes; unchanged
    where these are all or none.

    An entry may have another folder or suffix where only one name is the same otherwise.
    """
    stems = Counter(_stem(image.name) for image in images)
    known = {}
    for image in images:
        known[image.name] = image.name
        if stems[_stem(image.name)] == 1:
            known.setdefault(_stem(image.name), image.name)
    named = set()
    notes: list[str] = []
    for entry in entries:
        name = known.get(PureWindowsPath(entry).as_posix()) or known.get(_stem(entry))
        if name:
            named.add(name)
        elif not notes:
            notes.append(f"names in {source} are of no photograph, such as {as_text(entry)}")
    testing = [(image.name in named) != training for image in images]
    if len(set(testing)) == 1:
        extent = "all" if testing[0] else "none"
        return images, [f"{source} holds out {extent} of the photographs and is not used", *notes]
    notes.insert(0, f"held out are {sum(testing)} photographs, those of {source}")
    marks = zip(images, testing, strict=True)
    return [replace(image, held_out=mark) for image, mark in marks], notes


def _stem(name: str) -> str:
    return PureWindowsPath(name).stem.casefold()


def check_posed(image: PosedImage, source: Path) -> PosedImage:
    """The image; rejects a camera or pose that is not finite, too large, or cannot become a
    pinhole.
    """
    camera = image.camera
    if not camera.is_perspective_pinhole() and not camera.is_perspective_fisheye():
        raise ClodError(
            f"{source}: image {image.name!r} has camera model {camera.model_name}, no perspective"
            " camera; cut perspective views from it first"
        )
    lengths = [camera.focal_length_x, camera.focal_length_y, camera.width, camera.height]
    numbers = np.abs([*image.viewmat.ravel(), *camera.params, *lengths])
    if not (numbers < HUGE).all() or min(lengths) <= 0:  # a comparison with NaN is false
        raise ClodError(
            f"{source}: image {image.name!r} has a camera or pose that is not usable; export it"
            " again"
        )
    return image


def read_colmap(model: Path) -> tuple[list[PosedImage], list[str]]:
    """The images of a model, sorted by name, and notes."""
    form = form_of(model)
    path = model / f"images{form}"
    cameras = _cameras(model / f"cameras{form}")
    with rejected_if_damaged(path, DAMAGED):
        records = sorted((_images if form == ".bin" else _images_in_text)(path))
        stated = re.search(rb"^# *Number of images: *(\d+)", read_bytes(path, START), re.MULTILINE)
    posed = []
    for name, pose, camera in records:
        plain_name(name, path)
        if camera not in cameras:
            raise ClodError(
                f"{path}: image {name!r} has camera {camera}, which is not in cameras{form}; export"
                " both"
            )
        viewmat = np.eye(4)
        with rejected_if_damaged(path, f"image {name!r} has no rotation"):
            # of any length; scipy has w last
            viewmat[:3, :3] = Rotation.from_quat(np.roll(pose[:4], -1)).as_matrix()
        viewmat[:3, 3] = pose[4:]
        posed.append(check_posed(PosedImage(name, viewmat, cameras[camera]), model))
    if not posed:
        raise ClodError(f"{model}: the model has no registered image; run COLMAP's mapper again")
    notes = []
    if stated is not None and int(stated[1]) != len(posed):
        notes.append(
            f"{path.name} has {len(posed)} images, but its header says {int(stated[1])}: it may be"
            " incomplete"
        )
    split = model / SPLIT
    if split.is_file():
        entries = [line.decode("utf-8", "surrogateescape") for _, line in _lines(split)]
        posed, split_notes = marked(posed, entries, SPLIT)
        notes += split_notes
    return posed, notes


def load_points(folder: str | Path, origin: Sequence[float] = NOWHERE) -> torch.Tensor:
    """``[M, 3]`` float64, the points of the scene's COLMAP model less ``origin``; none without a
    model.
    """
    model = find_cameras(Path(folder))
    points: list[Sequence[float]] = []
    for path in (model / "points3D.bin", model / "points3D.txt"):
        if path.is_file() and not points:
            with rejected_if_damaged(path, DAMAGED):
                points = list((_points if path.suffix == ".bin" else _points_in_text)(path))
    return torch.from_numpy(np.array(points, np.float64).reshape(-1, 3) - origin)


def _cameras(path: Path) -> dict[int, pycolmap.Camera]:
    cameras = {}
    with rejected_if_damaged(path, DAMAGED):
        for camera in (_camera_records if path.suffix == ".bin" else _cameras_in_text)(path):
            if not camera.verify_params():
                raise ValueError(f"camera {camera.camera_id} has {len(camera.params)} parameters")
            cameras[camera.camera_id] = camera
    return cameras


class _Records:
    """The values of a binary file, from its start on; COLMAP's own reader reads past the end of a
    cut one.
    """

    def __init__(self, path: Path) -> None:
        self.data = read_bytes(path)
        self.at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from(f"<{layout}", self.data, self.at)
        self.at += struct.calcsize(f"<{layout}")
        return values

    def take_name(self) -> str:
        start = self.at
        end = self.data.index(b"\0", self.at)
        self.at = end + 1
        return self.data[start:end].decode("utf-8", "surrogateescape")

    def each(self) -> Iterator[int]:
        """The numbers of the records that the file states; rejects another end than the last's."""
        yield from range(*self.take("Q"))
        if self.at != len(self.data):
            raise ValueError(f"its last record ends at byte {self.at} of {len(self.data)}")

    def skip(self, size: int) -> None:
        self.at += size


def _camera_records(path: Path) -> Iterator[pycolmap.Camera]:
    records = _Records(path)
    for _ in records.each():
        number, kind, *size = records.take("IiQQ")
        camera = pycolmap.Camera.create_from_model_id(
            number, pycolmap.CameraModelId(kind), 1.0, *size
        )
        camera.params = list(records.take(f"{len(camera.params)}d"))
        yield camera


def _images(path: Path) -> Iterator[Image]:
    """Name, quaternion and translation from world to camera, and number of the camera."""
    records = _Records(path)
    for _ in records.each():
        _, *pose, camera = records.take("I7dI")
        yield records.take_name(), pose, camera
        records.skip(24 * records.take("Q")[0])  # keypoints


def _points(path: Path) -> Iterator[Sequence[float]]:
    records = _Records(path)
    for _ in records.each():
        # number, position, colour, error, count of observations
        point = records.take("Q3d3BdQ")
        yield point[1:4]
        records.skip(8 * point[-1])


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Number and content of the lines that are neither blank nor comments."""
    text = read_bytes(path).removeprefix(BOM_UTF8)
    reject_long_numbers(path, text)
    for number, line in enumerate(map(bytes.strip, text.splitlines()), start=1):
        if line and not line.startswith(b"#"):
            yield number, line


def _cameras_in_text(path: Path) -> Iterator[pycolmap.Camera]:
    for _, line in _lines(path):
        number, kind, *values = line.split()
        size = map(int, values[:2])
        camera = pycolmap.Camera.create_from_model_name(int(number), kind.decode(), 1.0, *size)
        camera.params = list(map(float, values[2:]))
        yield camera


def _images_in_text(path: Path) -> Iterator[Image]:
    """An image's line is followed by one of its keypoints, which is blank or missing where there
    are none.
    """
    may_be_keypoints = False
    for number, line in _lines(path):
        if may_be_keypoints and _is_keypoints(line):
            may_be_keypoints = False
            continue
        fields = line.split(maxsplit=9)  # a name may have spaces
        if len(fields) < 10:
            raise ValueError(
                f"line {number} is neither an image with its camera and name nor keypoints of one"
            )
        pose = list(map(float, fields[1:8]))
        yield fields[9].decode("utf-8", "surrogateescape"), pose, int(fields[8])
        may_be_keypoints = True


def _is_keypoints(line: bytes) -> bool:
    """Whether the line has x, y and the number of a point, -1 for none, of each keypoint."""
    fields = line.split()
    return len(fields) % 3 == 0 and fields[-1].removeprefix(b"-").isdigit()


def _points_in_text(path: Path) -> Iterator[Sequence[float]]:
    for _, line in _lines(path):
        yield list(map(float, line.split(maxsplit=4)[1:4]))
