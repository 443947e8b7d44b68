"""COLMAP models: their posed images."""

from __future__ import annotations

from copy import copy
from pathlib import Path

import numpy as np

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap_library import pycolmap
from clod_adapter.io.scene.colmap_records import check_records
from clod_adapter.io.scene.folder import name_parts
from clod_adapter.io.scene.posed import PosedImage, check_posed


def read_model(model: Path) -> tuple[list[PosedImage], list[str]]:
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
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ClodError(f"{model}: COLMAP cannot read this model ({reason}); copy or export it again") from error
    if not posed:
        raise ClodError(f"{model}: the model has no registered image; run COLMAP's mapper again")
    unposed = len(images) - len(posed)
    return posed, [f"{unposed} images of the model have no pose and are left out"] if unposed else []


def _posed_image(model: Path, image: pycolmap.Image) -> PosedImage:
    assert image.camera is not None  # a Reconstruction gives every image its camera
    viewmat = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
    # A copy, as the image's own is part of the whole reconstruction and keeps it in memory.
    return check_posed(PosedImage(image.name, viewmat, copy(image.camera)), model)
