"""Pinhole cameras, and photographs with the camera that took them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from clod_adapter._support.arrays import float_tensor, tensor_of
from clod_adapter.config import number
from clod_adapter.errors import ClodError

T = TypeVar("T")
NEAR = 0.01
"""Distance of the near plane, world units, as in gsplat."""
# pixels a side that an image of half the size has at least: smaller ones show too little
SMALLEST = 128
BENT = 0.01  # a product of two axes of a rotation may differ so much from 0 or 1
# of the distance from 0: float32 does not resolve cameras closer together than that
ROUNDING = 1e-6


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV axes (x right, y down, z forward).

    The matrices may be given as numpy arrays, which become float32 tensors.

    Attributes:
        viewmat: ``[4, 4]`` world to camera.
        K: ``[3, 3]`` intrinsics in pixels; pixel centres lie at +0.5.
        width, height: image size in pixels.
        name: the photograph's name, for messages.
        near: distance of the near plane, world units; Gaussians with a nearer centre are not drawn.

    Raises:
        ClodError: a matrix has the wrong shape or the image has no pixels; or of matrices in main
            memory a value is not finite, ``viewmat`` is no rotation and translation, or ``K`` has
            skew, a focal length that is not positive, or another last row than 0, 0, 1.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    name: str = ""
    near: float = NEAR

    def __post_init__(self) -> None:
        for name in ("viewmat", "K"):
            object.__setattr__(self, name, numbers_of(name, getattr(self, name)))
        if tuple(self.viewmat.shape) != (4, 4) or tuple(self.K.shape) != (3, 3):
            raise ClodError(f"camera {self.name!r} needs viewmat [4, 4] and K [3, 3]")
        for size in (self.width, self.height):
            if not isinstance(size, Integral) or size < 1:
                raise ClodError(
                    f"camera {self.name!r} has size {self.width}x{self.height}; give whole numbers"
                )
        if not 0 <= number(self.near) < math.inf:
            raise ClodError(
                f"camera {self.name!r} has its near plane at {self.near}, it must be finite and at"
                " least 0"
            )
        if self.viewmat.device.type == self.K.device.type == "cpu":  # the host would wait for a GPU
            _check_matrices(self.name, self.viewmat, self.K)

    def __repr__(self) -> str:
        return f"Camera({self.name!r}, {self.width}x{self.height})"

    def halved(self) -> Camera:
        """The same view with half the width and height; the last column or row of an odd size is
        left out.
        """
        K = self.K * self.K.new_tensor([[0.5], [0.5], [1.0]])
        return replace(self, K=K, width=self.width // 2, height=self.height // 2)

    def resized(self, width: int, height: int) -> Camera:
        """The same view with another width and height."""
        shrink = self.K.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return replace(self, K=self.K * shrink, width=width, height=height)

    @property
    def halvable(self) -> bool:
        """Whether an image of half the size shows enough: at least SMALLEST pixels a side."""
        return min(self.width, self.height) >= 2 * SMALLEST

    @property
    def position(self) -> Tensor:
        """``[3]`` the camera centre in world units, ``-R^T t``."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def depths(self, means: Tensor) -> Tensor:
        """``[N]`` distances of the centres ``means [N, 3]`` along the optical axis, world units."""
        row = self.viewmat[2].to(means)
        return means @ row[:3] + row[3]


def looking(eye: Tensor, forward: Tensor, down: Tensor) -> Tensor:
    """``[4, 4]`` viewmat at ``eye`` along the unit vector ``forward``, with ``down`` below."""
    right = torch.nn.functional.normalize(torch.linalg.cross(down, forward), dim=0)
    viewmat = torch.eye(4, dtype=forward.dtype)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """``[3, 3]`` float32 K of focal lengths and principal point, pixels."""
    rows = [
        [fx, 0, cx],
        [0, fy, cy],
        [0, 0, 1],
    ]
    return torch.tensor(rows, dtype=torch.float32)


def numbers_of(name: str, values: Any) -> Tensor:
    """``float_tensor`` of an argument; ClodError, with its name, where it is no array of
    numbers.
    """
    try:
        return float_tensor(values)
    except (TypeError, ValueError) as error:
        raise ClodError(f"{name} is {values!r:.80}, it must be an array of numbers") from error


def _check_matrices(name: str, viewmat: Tensor, K: Tensor) -> None:
    """Rejects what is no pinhole camera."""
    (fx, skew, _), (other_skew, fy, _), last = K.tolist()
    turn = viewmat[:3, :3].double()
    bent = (turn @ turn.T - torch.eye(3).to(turn)).abs().max()
    defect = ""
    if not (viewmat.isfinite().all() and K.isfinite().all()):
        defect = "a value that is not finite"
    elif bent >= BENT or viewmat[3].tolist() != [0, 0, 0, 1]:
        defect = "a viewmat that is no rotation and translation"
    elif fx <= 0 or fy <= 0:
        defect = "a focal length that is not positive"
    elif skew != 0 or other_skew != 0 or last != [0, 0, 1]:
        defect = "a K with skew, or whose last row is not 0, 0, 1"
    if defect:
        raise ClodError(f"camera {name!r} has {defect}")


@dataclass(frozen=True, eq=False)
class View:
    """One photograph and its camera. Compares by identity.

    Attributes:
        camera: where it was taken from.
        image: ``[H, W, 3]`` uint8, sRGB as stored in the file; a numpy array becomes a tensor.
    """

    camera: Camera
    image: Tensor

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", tensor_of(self.image))
        _check_image(self.camera, self.image)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.camera.name!r}, {self.camera.width}x{self.camera.height})"
        )

    def at(self, camera: Camera) -> View:
        """The same photograph with another camera of its size."""
        return View(camera, self.image)

    def halved(self) -> View:
        """The photograph at half the size, by means of 2x2 pixels, with the camera for it; made
        when it is read.
        """
        camera = self.camera.halved()

        def image() -> Tensor:
            pixels = self.image[: 2 * camera.height, : 2 * camera.width]
            pairs = pixels[::2].short() + pixels[1::2]
            squares = pairs[:, ::2] + pairs[:, 1::2]
            return ((squares + 2) >> 2).to(torch.uint8)

        return StoredView(camera, image)


class StoredView(View):
    """A view that reads its photograph, by ``image``, on every access; a pickle or a copy is a View
    that holds it.
    """

    # a Tensor from replace
    def __init__(self, camera: Camera, image: Callable[[], Tensor] | Tensor) -> None:
        object.__setattr__(self, "camera", camera)
        object.__setattr__(self, "_read", (lambda: image) if isinstance(image, Tensor) else image)

    def __reduce__(self) -> tuple[type[View], tuple[Camera, Tensor]]:
        return View, (self.camera, self.image)

    @property
    def image(self) -> Tensor:  # type: ignore[override]
        image: Tensor = self._read()  # type: ignore[attr-defined]
        _check_image(self.camera, image)
        return image

    def at(self, camera: Camera) -> View:
        return StoredView(camera, self._read)  # type: ignore[attr-defined]


def _check_image(camera: Camera, image: Tensor) -> None:
    expected = (camera.height, camera.width, 3)
    if tuple(image.shape) != expected or image.dtype != torch.uint8:
        raise ClodError(f"view {camera.name!r}: image must be uint8 of shape {expected}")


@dataclass(frozen=True)
class Scene:
    """Posed photographs, sorted by name; every 8th is held out, the usual split.

    Attributes:
        train: views for training.
        test: held-out views.
        notes: changes made to the images when they were read, one line each, for the report.
        folder: where the photographs were read from; None for those that were rendered.
        left_out: skipped steps of reading, with their reasons:
            ``("undistortion", "all 97 cameras are pinholes")``.
    """

    train: tuple[View, ...]
    test: tuple[View, ...]
    notes: tuple[str, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    folder: Path | None = None

    def __repr__(self) -> str:
        views = [*self.train, *self.test]
        sizes = {f"{view.camera.width}x{view.camera.height}" for view in views}
        size = sizes.pop() if len(sizes) == 1 else f"{len(sizes)} sizes"
        return f"Scene({len(self.train)} training views, {len(self.test)} held out, {size})"


def camera_extent(cameras: Sequence[Camera]) -> float:
    """1.1 times the largest distance of a camera from their mean, world units (3DGS's unit for
    position steps).

    At most 3.3 times their median, unless that is 0: one distant camera does not count. 0 for
    cameras in one place.
    """
    centres = torch.stack([camera.position for camera in cameras])
    distances = (centres - centres.mean(0)).norm(dim=1)
    distances = distances * (distances > ROUNDING * centres.norm(dim=1).max())
    largest = float(distances.max())
    middle = float(distances.median())
    return 1.1 * (min(largest, 3 * middle) or largest)


def near_plane(extent: float) -> float:
    """Distance of the near plane, world units, > 0: NEAR, scaled by the extent of the cameras if
    that is below 1.
    """
    return NEAR * min(extent, 1.0)  # a scene in kilometres would lie in front of NEAR


def with_near_planes(cameras: Sequence[Camera]) -> list[Camera]:
    """All cameras of a scene, with the near plane of ``near_plane``; cameras in one place keep
    theirs.
    """
    extent = camera_extent(cameras) if cameras else 0.0
    if not extent:
        return list(cameras)
    return [replace(camera, near=near_plane(extent)) for camera in cameras]


def in_its_unit(scene: Scene) -> Scene:
    """The scene with the near planes of ``with_near_planes``."""
    views = (*scene.train, *scene.test)
    cameras = with_near_planes([view.camera for view in views])
    moved = tuple(view.at(camera) for view, camera in zip(views, cameras, strict=True))
    count = len(scene.train)
    return replace(scene, train=moved[:count], test=moved[count:])


def spread(views: Sequence[T], most: int) -> Sequence[T]:
    """Evenly spread views, at most ``most``."""
    if len(views) <= most:
        return views
    return [views[k * len(views) // most] for k in range(most)]
