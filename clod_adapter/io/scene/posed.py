"""A photograph's pose and camera, of a COLMAP model or a transforms file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap_library import pycolmap

TEST_EVERY = 8  # one view in this many is held out
HUGE = 1e9  # world units and pixels; larger values are damage, and may not fit float32


@dataclass(frozen=True)
class PosedImage:
    """A photograph's name, pose and camera.

    Attributes:
        name: its path in the folder of photographs, parts joined by /.
        viewmat: ``[4, 4]`` float64, world to camera, OpenCV axes.
        camera: any of COLMAP's perspective models; pixel centres lie at +0.5.
        held_out: whether the scene marks it for testing; None where the scene marks none.
    """

    name: str
    viewmat: np.ndarray
    camera: pycolmap.Camera
    held_out: bool | None = None

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
    """Names of the test images: those that the scene marks, else the 0th and every ``test_every``-th.

    A single image is for training.
    """
    if any(image.held_out is not None for image in images):
        return {image.name for image in images if image.held_out}
    return {image.name for image in images[::test_every]} if len(images) > 1 else set()


def check_posed(image: PosedImage, source: Path) -> PosedImage:
    """The image as it is.

    Raises:
        ClodError: its camera or pose is not finite, too large, or cannot be undistorted to a pinhole.
    """
    camera = image.camera
    if not camera.is_perspective_pinhole() and not camera.is_perspective_fisheye():
        raise ClodError(
            f"{source}: image {image.name!r} has camera model {camera.model_name}, no perspective camera; cut "
            "perspective views from it first"
        )
    focals = [camera.focal_length_x, camera.focal_length_y]
    numbers = np.concatenate([image.viewmat.ravel(), camera.params])
    sized = 0 < camera.width < HUGE and 0 < camera.height < HUGE
    if not sized or not (np.abs(numbers) < HUGE).all() or min(focals) <= 0:  # a comparison with NaN is false
        raise ClodError(
            f"{source}: image {image.name!r} has a camera or pose that is not usable; copy or export it again"
        )
    return image
