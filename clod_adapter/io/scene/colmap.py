"""COLMAP models: their posed images and points, and writing one."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from pathlib import Path

import numpy as np
import torch

from clod_adapter.cameras import Camera
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.scene.colmap_library import pycolmap
from clod_adapter.io.scene.colmap_records import check_records
from clod_adapter.io.scene.folder import find_cameras, name_parts
from clod_adapter.io.scene.posed import PosedImage, check_posed
from clod_adapter.origin import NOWHERE


def read_colmap(model: Path) -> tuple[list[PosedImage], list[str]]:
    """The registered images of a model, sorted by name, and notes.

    Raises:
        ClodError: the model is damaged or empty, or a camera is not usable.
    """
    check_records(model)
    try:
        reconstruction = pycolmap.Reconstruction(str(model))
        images = sorted(reconstruction.images.values(), key=lambda image: image.name)
        for image in images:
            name_parts(image.name, model)
        posed = [_posed_image(model, image) for image in images if image.has_pose]
    except (ValueError, OverflowError, IndexError, KeyError, RuntimeError, MemoryError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ClodError(f"{model}: COLMAP cannot read this model ({reason}); copy or export it again") from error
    if not posed:
        raise ClodError(f"{model}: the model has no registered image; run COLMAP's mapper again")
    unposed = len(images) - len(posed)
    return posed, [f"{unposed} images of the model have no pose and are left out"] if unposed else []


def load_points(folder: str | Path, origin: Sequence[float] = NOWHERE) -> torch.Tensor:
    """``[M, 3]`` float64, the points of the scene's COLMAP model less ``origin``, world units; none without a model.

    The model is one that loads.
    """
    model = find_cameras(Path(folder))
    points = pycolmap.Reconstruction(str(model)).points3D.values() if model.is_dir() else ()
    return torch.from_numpy(np.array([point.xyz for point in points], np.float64).reshape(-1, 3) - origin)


def write_model(
    folder: str | Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    points: np.ndarray | None = None,
    colors: np.ndarray | None = None,
) -> None:
    """Writes a binary COLMAP model to ``folder/sparse/0``, which must not exist or be empty.

    Args:
        folder: an existing folder.
        cameras: one per image; those with the same intrinsics and size share a PINHOLE camera.
        names: the images' names under ``folder/images``.
        points: ``[M, 3]`` positions for points3D, world units; without them it is empty.
        colors: ``[M, 3]`` uint8 RGB of the points, which are black without.

    Raises:
        ClodError: names and cameras differ in number, or the model cannot be written there.
    """
    if len(names) != len(cameras) or len(set(names)) != len(names):
        raise ClodError(f"{folder}: {len(cameras)} cameras need as many different names, {len(set(names))} were given")
    reconstruction = pycolmap.Reconstruction()
    ids: dict[tuple[float, ...], int] = {}
    for image_id, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
        K = camera.K.double().cpu()
        params = (K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item())
        key = (camera.width, camera.height, *params)
        if key not in ids:
            ids[key] = len(ids) + 1
            size = {"width": camera.width, "height": camera.height}
            pinhole = pycolmap.Camera(model="PINHOLE", params=params, camera_id=ids[key], **size)
            reconstruction.add_camera_with_trivial_rig(pinhole)
        image = pycolmap.Image(name=name, camera_id=ids[key], image_id=image_id)
        pose = pycolmap.Rigid3d(camera.viewmat[:3].double().cpu().numpy())
        reconstruction.add_image_with_trivial_frame(image, pose)
    xyz = np.zeros((0, 3)) if points is None else np.asarray(points, np.float64)
    rgb = np.zeros(xyz.shape, np.uint8) if colors is None else np.asarray(colors, np.uint8)
    for position, color in zip(xyz, rgb, strict=True):
        reconstruction.add_point3D(position, pycolmap.Track(), color)
    target = Path(folder) / "sparse" / "0"
    if Path(folder).is_dir():
        target.parent.mkdir(exist_ok=True)
    with atomic_path(target) as temporary:
        temporary.mkdir()
        reconstruction.write_binary(str(temporary))


def _posed_image(model: Path, image: pycolmap.Image) -> PosedImage:
    assert image.camera is not None  # a Reconstruction gives every image its camera
    pose = image.cam_from_world()
    viewmat = np.vstack([pose.matrix(), [0, 0, 0, 1]])
    if hasattr(pose, "rotation") and not np.linalg.norm(pose.rotation.quat) > 0.5:
        viewmat[:3, :3] = np.nan  # pycolmap takes a quaternion of no length for no rotation; colmap_plain gives NaN
    # A copy, as the image's own is part of the whole reconstruction and keeps it in memory.
    return check_posed(PosedImage(image.name, viewmat, copy(image.camera)), model)
