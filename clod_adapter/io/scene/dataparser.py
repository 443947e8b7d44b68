"""The frame that nerfstudio trained in: ``dataparser_transforms.json``, which ns-train writes beside its config.yml.

nerfstudio rotates, moves and scales its cameras, trains in that frame and exports its splats in it. With
``transform`` the file's 3x4 matrix ``[R | t]`` and ``scale`` its number, a point ``x`` of the world that the data came
in (COLMAP's, where ``ns-process-data`` or the colmap dataparser turned it first) is in that frame

    x_trained = scale (R x + t)

and a camera, whose picture does not depend on the unit of length,

    [R_c | t_c]  becomes  [R_c R^T | scale (t_c - R_c R^T t)]

Cameras are brought into the splat's frame, not the splat into theirs, which is exact for the harmonics too.

Source: nerfstudio 1.1, ``base_dataparser.save_dataparser_transform`` and ``nerfstudio_dataparser``, which multiplies
``transform`` by the ``applied_transform`` of a transforms.json, and ``scale`` by its ``applied_scale``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.posed import HUGE, PosedImage, check_posed
from clod_adapter.io.scene.transforms import DATAPARSER, read_json, read_pose


@dataclass(frozen=True)
class TrainedFrame:
    """The similarity ``x_trained = scale (rotation x + offset)`` of the cameras' world.

    Attributes:
        rotation: ``[3, 3]`` float64, proper.
        offset: ``[3]`` world units before scaling.
        scale: positive.
        note: for the scene's notes.
    """

    rotation: np.ndarray
    offset: np.ndarray
    scale: float
    note: str

    def bring(self, images: Sequence[PosedImage], source: Path) -> list[PosedImage]:
        """The images with their cameras in that frame.

        Raises:
            ClodError: a pose is not usable there.
        """
        brought = []
        for image in images:
            viewmat = np.eye(4)
            viewmat[:3, :3] = image.viewmat[:3, :3] @ self.rotation.T
            viewmat[:3, 3] = self.scale * (image.viewmat[:3, 3] - viewmat[:3, :3] @ self.offset)
            brought.append(check_posed(replace(image, viewmat=viewmat), source))
        return brought


def trained_frame(folder: Path, cameras: Path) -> TrainedFrame | None:
    """The frame that ``folder/dataparser_transforms.json`` gives the cameras of a scene; None where there is none.

    Args:
        cameras: what ``find_cameras`` found: a model's folder, or a transforms file, whose ``applied_transform`` and
            ``applied_scale`` are taken out again, as its poses have them already.

    Raises:
        ClodError: the file is damaged, or holds no rotation, translation and scale.
    """
    path = folder / DATAPARSER
    if not path.is_file():
        return None
    values = _object(path)
    pose, scale = read_pose(path, values, "transform"), _number(path, values.get("scale", 1.0), "scale")
    if cameras.is_file():
        applied = _object(cameras)
        if applied.get("applied_transform") is not None:
            pose = pose @ np.linalg.inv(read_pose(cameras, applied, "applied_transform"))
        if applied.get("applied_scale") is not None:
            scale /= _number(cameras, applied["applied_scale"], "applied_scale")
    left, _, right = np.linalg.svd(pose[:3, :3])
    note = f"the cameras are brought into the frame of {DATAPARSER}: the splat must be what nerfstudio exported"
    return TrainedFrame(left @ right, pose[:3, 3], scale, note)


def _object(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise ClodError(f"{path}: is no JSON object; copy it again from beside the config.yml of ns-train")
    return content


def _number(path: Path, value: Any, key: str) -> float:
    usable = isinstance(value, int | float) and not isinstance(value, bool) and 1 / HUGE < value < HUGE
    if not usable:
        raise ClodError(f"{path}: {key} is {value!r:.40}, it must be a positive number; copy or export it again")
    return float(value)
