"""Frames of checkpoints that differ from that of the cameras: swapped axes, inverted poses,
normalized worlds.

A frame is a similarity ``x_cameras = s R x_file + t``. The cameras are transformed into the frame
of the file, which is exact for spherical harmonics too: ``[R_c | t_c]`` becomes
``[R_c R | (R_c t + t_c) / s]``.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

GSPLAT = (
    "the checkpoint is in gsplat's normalized frame: train with --no-normalize-world-space, or undo"
    " the transform"
)
NERFSTUDIO = (
    "the checkpoint is in nerfstudio's normalized frame: copy dataparser_transforms.json to the"
    " scene"
)
AXES = ("x", "y", "z", "-x", "-y", "-z")
ROUNDS = 20  # of the reweighted least squares
# Of principal axes, which have none: those that turn, and do not mirror.
SIGNS = (
    (1.0, 1, 1),
    (1.0, -1, -1),
    (-1.0, 1, -1),
    (-1.0, -1, 1),
)
# Rotations of COLMAP's world in nerfstudio's readers before normalization: none, the current one,
# the older one.
NERFSTUDIO_TURNS = (
    ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
)


# Poses that COLMAP's differ from: name, whether they are camera to world, whether the cameras look
# along -z with y up, and what to do.
POSES = (
    (
        "OpenGL poses",
        False,
        True,
        "the cameras look along -z with y up (OpenGL), where COLMAP's look along z with y down:"
        " negate the y and z axes of their poses",
    ),
    (
        "inverted poses",
        True,
        False,
        "the poses are camera to world, where COLMAP's are world to camera: invert them",
    ),
    (
        "inverted OpenGL poses",
        True,
        True,
        "the poses are camera to world in OpenGL's axes, where COLMAP's are world to camera:"
        " negate their y and z axes and invert them",
    ),
)


@dataclass(frozen=True)
class Frame:
    """A frame of the file, ``x_cameras = scale rotation x_file + offset``, after the poses were
    corrected.
    """

    name: str
    description: str  # cause and remedy, for messages
    rotation: Tensor = torch.eye(3, dtype=torch.float64)  # of a mirrored frame, determinant -1
    scale: float = 1.0
    offset: Tensor = torch.zeros(3, dtype=torch.float64)
    inverted: bool = False  # the poses given are camera to world
    opengl: bool = False  # the cameras look along -z with y up

    def of(self, viewmats: Tensor) -> Tensor:
        """``[V, 4, 4]`` float64, world to camera in the file's frame, of cameras as they were
        given.
        """
        viewmats = viewmats.double()
        if self.inverted:
            viewmats = torch.linalg.inv(viewmats)
        if self.opengl:
            viewmats = torch.diag(viewmats.new_tensor([1.0, -1, -1, 1])) @ viewmats
        return into_file(viewmats, self.rotation, self.scale, self.offset)

    def as_dict(self) -> dict[str, Any]:
        """The fields, for reports."""
        return vars(self) | {"rotation": self.rotation.tolist(), "offset": self.offset.tolist()}


def known_frames(viewmats: Tensor, points: Tensor | None = None) -> list[Frame]:
    """The frames that follow from all cameras ``[V, 4, 4]`` and the scene's points, by which
    trainers normalize.
    """
    poses = [
        Frame(name, text, inverted=inverted, opengl=opengl)
        for name, inverted, opengl, text in POSES
    ]
    return [*poses, *_axes(viewmats), *_nerfstudio(viewmats), *_gsplat(viewmats, points)]


def into_file(viewmats: Tensor, rotation: Tensor, scale: float, offset: Tensor) -> Tensor:
    """``[V, 4, 4]`` the cameras in the file's frame, for
    ``x_cameras = scale rotation x_file + offset``.
    """
    out = viewmats.clone()
    turns = viewmats[:, :3, :3]
    out[:, :3, :3] = turns @ rotation
    out[:, :3, 3] = (turns @ offset + viewmats[:, :3, 3]) / scale
    return out


def focus_of(viewmats: Tensor) -> Tensor:
    """``[3]`` the point of least distances to the optical axes, by reweighted least squares: one
    far camera does not decide it. The mean centre if the axes are parallel.
    """
    poses = torch.linalg.inv(viewmats.double())
    centres = poses[:, :3, 3]
    forward = poses[:, :3, 2]
    along = forward[:, :, None] * forward[:, None, :]
    across = torch.eye(3, dtype=poses.dtype) - along
    if float(torch.linalg.cond(across.mean(0))) > 1e4:
        return centres.mean(0)
    weights = across.new_ones(len(across))
    for _ in range(ROUNDS):
        rows = weights[:, None, None] * across
        products = (rows @ centres[:, :, None]).mean(0)
        focus = torch.linalg.solve(rows.mean(0), products)[:, 0]
        away = (across @ (focus - centres)[:, :, None]).flatten(1).norm(dim=1)
        least = max(0.01 * float(away.median()), 1e-9)
        weights = 1 / away.clamp(min=least)
    return focus


def _axes(viewmats: Tensor) -> Iterator[Frame]:
    """The 47 other signed permutations of the axes, including mirrored ones."""
    identity = torch.eye(3, dtype=viewmats.dtype)
    rows = torch.cat([identity, -identity])
    for order in itertools.permutations(range(6), 3):
        rotation = rows[list(order)]
        if rotation.equal(identity) or torch.linalg.det(rotation) == 0:
            continue
        names = ", ".join(AXES[k] for k in order)
        mirrored = " (mirrored)" if torch.linalg.det(rotation) < 0 else ""
        text = (
            f"the cameras' x, y, z are the file's {names}{mirrored}: export the checkpoint without"
            " that rotation"
        )
        yield Frame(f"axes {names}", text, rotation)


def _nerfstudio(viewmats: Tensor) -> Iterator[Frame]:
    """nerfstudio's default: mean up direction to z, mean centre to the origin, largest coordinate
    to 1.
    """
    poses = torch.linalg.inv(viewmats)
    for rows in NERFSTUDIO_TURNS:
        turn = viewmats.new_tensor(rows)
        centres = poses[:, :3, 3] @ turn.T
        up = turn @ -poses[:, :3, 1].mean(0)
        rotation = _turning(up, viewmats.new_tensor([0.0, 0, 1]))
        middle = centres.mean(0)
        farthest = float(((centres - middle) @ rotation.T).abs().max())
        if farthest > 0:
            offset = -rotation @ middle
            yield _normalized("nerfstudio", NERFSTUDIO, rotation @ turn, 1 / farthest, offset)


def _gsplat(viewmats: Tensor, points: Tensor | None) -> Iterator[Frame]:
    """gsplat's ``normalize``: up, focus and median distance of the cameras, then principal axes of
    the points.
    """
    poses = torch.linalg.inv(viewmats)
    up = -poses[:, :3, 1].mean(0)
    rotation = _turning(up, viewmats.new_tensor([0.0, -1, 0]))
    centres = poses[:, :3, 3] @ rotation.T
    forward = poses[:, :3, 2] @ rotation.T
    # quantile(0.5) is numpy's median; torch's takes the lower of two
    depths = (forward * centres).sum(1, keepdim=True)
    focus = (centres - depths * forward).quantile(0.5, dim=0)
    distance = float((centres - focus).norm(dim=1).quantile(0.5))
    if distance == 0:
        return
    yield _normalized("gsplat", GSPLAT, rotation, 1 / distance, -focus)
    if points is None or len(points) < 3:
        return
    turned = points.to(viewmats) @ rotation.T
    middle = turned.quantile(0.5, dim=0)
    covariance = (turned - middle).T.cov()
    axes = torch.linalg.eigh(covariance).eigenvectors.flip(1).T
    axes = axes * torch.linalg.det(axes).sign()
    for signs in SIGNS:
        turn = torch.diag(viewmats.new_tensor(signs)) @ axes
        yield _normalized("gsplat", GSPLAT, turn @ rotation, 1 / distance, -turn @ middle)


def _normalized(
    name: str,
    description: str,
    rotation: Tensor,
    scale: float,
    offset: Tensor,
) -> Frame:
    """The frame of ``x_file = scale (rotation x_cameras + offset)``."""
    return Frame(name, description, rotation.T, 1 / scale, -rotation.T @ offset)


def _turning(source: Tensor, target: Tensor) -> Tensor:
    """The smallest rotation from one direction to another."""
    rotation, _ = Rotation.align_vectors(target.numpy(), source.numpy())
    return torch.from_numpy(rotation.as_matrix())
