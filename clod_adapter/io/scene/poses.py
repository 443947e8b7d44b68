"""The cameras of a scene without its photographs, which need not exist."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from clod_adapter.cameras import Camera, with_near_planes
from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap import read_colmap
from clod_adapter.io.scene.dataparser import trained_frame
from clod_adapter.io.scene.folder import find_cameras
from clod_adapter.io.scene.posed import TEST_EVERY, held_out
from clod_adapter.io.scene.transforms import read_transforms
from clod_adapter.origin import NOWHERE


def load_cameras(
    folder: str | Path, origin: Sequence[float] = NOWHERE, *, training: bool = False
) -> tuple[list[Camera], list[str]]:
    """The cameras that ``scene.load_scene`` would give photographs to, sorted by name, and notes.

    A distorted one is the pinhole of the same focal length and centre, not that of its undistorted photograph. Of a
    transforms.json without sizes, cameras whose photograph is missing too are left out.

    Args:
        folder: the scene's, usually the one with ``sparse/0/`` or ``transforms.json``.
        origin: ``[3]`` what the world is to be relative to, in its units: ``Checkpoint.origin``.
        training: excludes those that ``load_scene`` holds out.

    Raises:
        ClodError: there are no cameras, or none is usable.
    """
    folder = Path(folder)
    source = find_cameras(folder)
    images, notes = (read_transforms if source.is_file() else read_colmap)(source)
    if frame := trained_frame(folder, source):
        images, notes = frame.bring(images, source), [*notes, frame.note]
    testing = held_out(images, TEST_EVERY) if training else set()
    cameras = []
    for image in images:
        pinhole = image.camera
        if min(pinhole.width, pinhole.height) > 1:
            viewmat = torch.from_numpy(image.relative_to(origin).viewmat).float()
            K = torch.from_numpy(pinhole.calibration_matrix()).float()
            cameras.append(Camera(viewmat, K, pinhole.width, pinhole.height, image.name))
    if unsized := len(images) - len(cameras):
        notes.append(f"{unsized} of {len(images)} cameras left out: neither {source.name} nor a photograph has a size")
    if not cameras:
        raise ClodError(
            f"{source}: has no size of a photograph, and no photograph is there; put them beside it, or w and h into it"
        )
    return [camera for camera in with_near_planes(cameras) if camera.name not in testing], notes
