"""Pinhole cameras, and photographs with the camera that took them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from clod_adapter.errors import ClodError


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV axes (x right, y down, z forward).

    Attributes:
        viewmat: ``[4, 4]`` world to camera.
        K: ``[3, 3]`` intrinsics in pixels; pixel centres lie at +0.5.
        width, height: image size in pixels.
        name: the photograph's name, for messages.

    Raises:
        ClodError: a matrix has the wrong shape or the image has no pixels.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    name: str = ""

    def __post_init__(self) -> None:
        if tuple(self.viewmat.shape) != (4, 4) or tuple(self.K.shape) != (3, 3):
            raise ClodError(f"camera {self.name!r} needs viewmat [4, 4] and K [3, 3]")
        if self.width < 1 or self.height < 1:
            raise ClodError(f"camera {self.name!r} has size {self.width}x{self.height}")

    @property
    def position(self) -> Tensor:
        """``[3]`` the camera centre in world units, ``-R^T t``."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


@dataclass(frozen=True)
class View:
    """One photograph and its camera.

    Attributes:
        camera: where it was taken from.
        image: ``[H, W, 3]`` uint8, sRGB as stored in the file.
    """

    camera: Camera
    image: Tensor

    def __post_init__(self) -> None:
        expected = (self.camera.height, self.camera.width, 3)
        if tuple(self.image.shape) != expected or self.image.dtype != torch.uint8:
            raise ClodError(f"view {self.camera.name!r}: image must be uint8 of shape {expected}")


@dataclass(frozen=True)
class Scene:
    """Posed photographs, split as the field does: sorted by name, every 8th is held out.

    Attributes:
        train: views to learn from.
        test: held-out views.
        notes: what was done to the images on the way in, one line each, for the report.
    """

    train: tuple[View, ...]
    test: tuple[View, ...]
    notes: tuple[str, ...] = ()
