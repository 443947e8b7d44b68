"""Cameras as nerfstudio, instant-ngp and Blender's synthetic scenes have them:
``transforms.json``.
"""

import math
from collections import ChainMap
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap import HUGE, PosedImage, check_posed, marked
from clod_adapter.io.scene.folder import (
    DATAPARSER,
    UNUSED,
    find_files,
    leaves,
    plain_name,
    read_json,
    with_ending,
)
from clod_adapter.io.scene.images import image_size

FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
PERSPECTIVE = (
    "",
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "PERSPECTIVE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
)

TRAINING = "train_filenames"  # nerfstudio's list in its transforms.json


def read_transforms(path: Path) -> tuple[list[PosedImage], list[str]]:
    """The frames of a transforms file, sorted by name, and notes.

    ``transform_matrix`` is camera to world in OpenGL axes (x right, y up, z back)::

        viewmat = inverse(transform_matrix diag(1, -1, -1, 1))

    The intrinsics are ``fl_x, fl_y, cx, cy, w, h``, or follow from ``camera_angle_x`` and the
    photograph's size, each in the frame or for all frames; the distortion is OpenCV's,
    ``k1 k2 p1 p2 k3``, or its fisheye's, ``k1 k2 k3 k4``. A ``file_path`` without an extension gets
    .png, .jpg or .jpeg, the first that is there.

    The frames of ``transforms_train.json`` are for training and those of ``transforms_test.json``
    beside it, where it is there, are held out; else those that the lists ``train_filenames``,
    ``val_filenames`` and ``test_filenames`` of one file hold out.

    Source: nerfstudio's documentation, "Data conventions"; instant-ngp's
    ``scripts/colmap2nerf.py``.
    """
    test = path.with_name(path.name.replace("train", "test"))
    has_test = test != path and test.is_file()
    images, notes = _frames(path, False if has_test else None)
    if has_test:
        images += _frames(test, True)[0]
        notes.append(f"held out are the photographs of {test.name}")
    return sorted(images, key=lambda image: image.name), notes


def _frames(path: Path, held_out: bool | None) -> tuple[list[PosedImage], list[str]]:
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ClodError(
            f"{path}: has no list of frames; give nerfstudio's or instant-ngp's transforms.json"
        )
    names = []
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise ClodError(f"{path}: frame {number} has no file_path; export the file again")
        name = plain_name(frame["file_path"], path, path.parent)
        names.append(with_ending(path.parent, name) or name)
    files, _ = find_files(path.parent, names)
    images = []
    for frame, name, file in zip(frames, names, files, strict=True):
        where = f"{path}: frame {name}"
        camera = _camera(where, file, ChainMap(frame, content))
        pose = read_pose(where, frame, "transform_matrix")
        viewmat = np.eye(4)
        viewmat[:3, :3] = (pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])).T
        viewmat[:3, 3] = -viewmat[:3, :3] @ pose[:3, 3]
        images.append(check_posed(PosedImage(name, viewmat, camera, held_out), path))
    notes: list[str] = []
    if held_out is None:
        images, notes = _split(path, content, images)
    if any(leaves(frame["file_path"]) for frame in frames):
        notes.append(f"paths of {path.name} lead out of its folder: photographs are those in it")
    if "applied_transform" in content and not path.with_name(DATAPARSER).is_file():
        notes.append(
            f"{path.name} turned COLMAP's world (applied_transform): a checkpoint of the turned one"
            " is needed"
        )
    if any("mask_path" in frame for frame in frames):
        notes.append(f"the masks of {path.name} are {UNUSED}")
    return images, notes


def _split(
    path: Path, content: Mapping[str, Any], images: list[PosedImage]
) -> tuple[list[PosedImage], list[str]]:
    """The images, those held out on which nerfstudio does not train by its lists, and notes."""
    lists = {}
    for key in (TRAINING, "val_filenames", "test_filenames"):
        entries = content.get(key)
        if entries is None:
            continue
        if not isinstance(entries, list) or not all(isinstance(name, str) for name in entries):
            raise ClodError(f"{path}: {key} is no list of file names; correct or remove it")
        lists[key] = [with_ending(path.parent, name) or name for name in entries]
    if not lists:
        return images, []
    training = TRAINING in lists
    entries = lists[TRAINING] if training else list(chain(*lists.values()))
    return marked(images, entries, f"the lists of {path.name}", training=training)


def read_pose(where: object, values: Mapping[str, Any], key: str) -> np.ndarray:
    """``[4, 4]`` float64: the rotation nearest to the file's rounded one, and translation under
    ``key``, 3x4 or 4x4.
    """
    pose: np.ndarray = np.zeros(0)
    with suppress(TypeError, ValueError, OverflowError):
        pose = np.array(values.get(key), np.float64)
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise ClodError(
            f"{where}: {key} is no 3x4 or 4x4 matrix of finite numbers; copy or export it again"
        )
    square = np.vstack([pose[:3], [0.0, 0.0, 0.0, 1.0]])
    turn = pose[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(turn.T @ turn - np.eye(3)).max()
    # A file may have few digits, but a scale or a mirror image would give a picture of another
    # scene.
    if not off < 0.01 or np.linalg.det(turn) < 0 or not np.array_equal(pose, square[: len(pose)]):
        raise ClodError(f"{where}: {key} is no rotation and translation; copy or export it again")
    left, _, right = np.linalg.svd(turn)
    square[:3, :3] = left @ right
    return square


def _number(
    where: object, values: Mapping[str, Any], key: str, default: float, above: float = -HUGE
) -> float:
    stated = default if values.get(key) is None else values[key]
    value = math.nan
    with suppress(TypeError, ValueError, OverflowError):
        value = float(stated)
    if isinstance(stated, bool) or not above < value < HUGE:
        raise ClodError(
            f"{where}: {key} is no number between {above:g} and {HUGE:g}, but {stated!r:.40}; copy"
            " or export the file again"
        )
    return value


def _camera(where: str, photograph: Path | None, values: Mapping[str, Any]) -> pycolmap.Camera:
    number = partial(_number, where, values)
    width, height = (int(number(key, 0)) for key in ("w", "h"))
    if width < 1 or height < 1:  # that of a missing photograph does not matter
        width, height = image_size(photograph) if photograph else (1, 1)
    fx = number("fl_x", 0) or _focal(width, number("camera_angle_x", 0))
    if fx <= 0:
        raise ClodError(
            f"{where}: has neither fl_x nor camera_angle_x above 0; export the file again"
        )
    fy = number("fl_y", 0) or _focal(height, number("camera_angle_y", 0)) or fx
    params = [fx, fy, number("cx", width / 2), number("cy", height / 2)]
    radial = [number(key, 0) for key in ("k1", "k2", "k3", "k4")]
    tangential = [number(key, 0) for key in ("p1", "p2")]
    k3, k4 = radial[2:]
    model = str(values.get("camera_model") or "")
    if model in FISHEYE or (model in PERSPECTIVE and values.get("is_fisheye")):
        return pycolmap.Camera(
            model="OPENCV_FISHEYE", width=width, height=height, params=params + radial
        )
    # of k4 some writers mean a power of the radius, some a divisor
    if model not in PERSPECTIVE or k4:
        feature = "k4 of a camera that is no fisheye" if k4 else f"camera_model {model[:40]!r}"
        raise ClodError(
            f"{where}: {feature} is not known; give the COLMAP model that the file was made from"
        )
    params += radial[:2] + tangential
    model = "OPENCV"
    if k3:
        params += [k3, 0, 0, 0]
        model = "FULL_OPENCV"
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def _focal(pixels: int, angle: float) -> float:
    """The focal length with which this many pixels see this angle; 0 where it is no angle."""
    return pixels / (2 * math.tan(angle / 2)) if 0 < angle < math.pi else 0.0


def in_trained_frame(
    folder: Path, cameras: Path, images: list[PosedImage]
) -> tuple[list[PosedImage], list[str]]:
    """The images in the frame that nerfstudio trained in, and a note; unchanged without its file in
    ``folder``.

    nerfstudio rotates, moves and scales its cameras, and exports its splats in that frame. With
    ``transform``, the 3x4 matrix ``[R | t]``, and ``scale`` of dataparser_transforms.json, a point
    ``x`` of the world of its data is there

        x_trained = scale (R x + t)

    and a camera ``[R_c | t_c]`` becomes ``[R_c R^T | scale (t_c - R_c R^T t)]``. Cameras are
    brought into the splat's frame, not the splat into theirs, which is exact for the harmonics too.

    Source: nerfstudio 1.1, ``base_dataparser.save_dataparser_transform`` and
    ``nerfstudio_dataparser``, which multiplies ``transform`` by the ``applied_transform`` of a
    transforms.json, and ``scale`` by its ``applied_scale``. These are taken out again, as the poses
    of that file have them already.
    """
    path = folder / DATAPARSER
    if not path.is_file():
        return images, []
    values = read_json(path)
    pose = read_pose(path, values, "transform")
    scale = _number(path, values, "scale", 1.0, 1 / HUGE)
    if cameras.is_file():
        applied = read_json(cameras)
        if applied.get("applied_transform") is not None:
            pose = pose @ np.linalg.inv(read_pose(cameras, applied, "applied_transform"))
        scale /= _number(cameras, applied, "applied_scale", 1.0, 1 / HUGE)
    back = np.linalg.inv(pose)
    brought = []
    for image in images:
        viewmat = image.viewmat @ back
        viewmat[:3, 3] *= scale
        brought.append(check_posed(replace(image, viewmat=viewmat), cameras))
    note = (
        f"the cameras are brought into the frame of {DATAPARSER}: the splat must be what nerfstudio"
        " exported"
    )
    return brought, [note]
