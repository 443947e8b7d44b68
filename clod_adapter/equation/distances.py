"""The normalised distance d of the dial's equation: of one camera, and one for each Gaussian over
several cameras.

For a camera with centre c, a Gaussian with centre mu and the unit D (all in world units)::

    d = |mu - c| / D

A plain file and an order of rows have one for each Gaussian, the geometric mean over the known
cameras v: ``d_i = exp(mean over v of log d_iv)``. A mean over the cameras that see it was no
better.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple

import torch
from torch import Tensor

from clod_adapter.cameras import Camera, intrinsics, looking
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.quality_table import Viewpoint

Place = Camera | Viewpoint
# times the median distance from the scene's centre: one camera that far away must not decide
OUTLIER = 16.0
# lower bound of d in the geometric mean: a camera in a Gaussian's centre must not decide alone
NEAREST = 1e-6


@torch.no_grad()
def normalized_distances(means: Tensor, camera: Camera, config: AttenuationConfig) -> Tensor:
    """``[N]`` the equation's d, without unit, >= 0, of ``means [N, 3]``, in float32 or, from
    float64, in float64.

    A constant for autograd: the dial adds nothing to the gradient of ``means``.
    """
    # float16's square overflows from 256 on
    means = means.to(torch.promote_types(means.dtype, torch.float32))
    # it would round the camera's position to 3 digits
    with torch.autocast(means.device.type, enabled=False):
        away = means - camera.position.to(means, non_blocking=means.device.type != "cpu")
        x, y, z = away.unbind(1)  # three times as fast as a norm over rows of 3
        distances = x.square().addcmul_(y, y).addcmul_(z, z).sqrt_()
        return distances.div_(normalizing_distance(distances, means, camera, config))


@torch.no_grad()
def normalizing_distance(
    distances: Tensor,
    means: Tensor,
    camera: Camera,
    config: AttenuationConfig,
) -> Tensor:
    """0-d, D, world units, > 0: ``config.scene_distance``, in the paper's form the largest distance
    in the view.

    That is taken over the Gaussians whose centre projects into the image from beyond the near
    plane, or over all where there is none. It is at least the smallest normal number, so that 0 / D
    is 0, and 1 where there are no Gaussians.
    """
    if config.form == "ours":
        return distances.new_full((), config.scene_distance)
    if len(distances) == 0:
        return distances.new_full((), 1.0)
    inside = in_frustum(means, camera)
    # Without a selection, for whose size the host would wait for a GPU.
    largest = distances.where(inside | ~inside.any(), 0).max()
    return largest.clamp(min=torch.finfo(distances.dtype).tiny)


def in_frustum(means: Tensor, camera: Camera) -> Tensor:
    """``[N]`` bool: the centre projects into the image, from beyond the near plane."""
    projection = (camera.K @ camera.viewmat[:3].to(camera.K)).to(
        means, non_blocking=means.device.type != "cpu"
    )
    x, y, z = projection[:, :3] @ means.T + projection[:, 3:]
    in_columns = (x >= 0) & (x < camera.width * z)
    in_rows = (y >= 0) & (y < camera.height * z)
    return (z > camera.near) & in_columns & in_rows


def median_distance(means: Tensor, camera: Camera) -> float:
    """Median distance of the centres ``means [N, 3]`` in the image, or of all if there is none;
    world units, 1 for no centres.
    """
    inside = in_frustum(means, camera)
    distances = (means - camera.position.to(means)).norm(dim=1)
    visible = distances[inside] if bool(inside.any()) else distances
    if len(visible) == 0:
        return 1.0
    return float(visible.median().clamp(min=torch.finfo(visible.dtype).tiny))


def viewpoint_of(camera: Camera, means: Tensor, config: AttenuationConfig) -> Viewpoint:
    """The viewpoint of a camera that looks at Gaussians with centres ``means [N, 3]``, world
    units.
    """
    position = camera.position.to(means)
    unit = config.scene_distance
    if config.form == "paper":
        distances = (means - position).norm(dim=1)
        unit = float(normalizing_distance(distances, means, camera, config))
    look = camera.viewmat[2, :3].tolist()
    up = (-camera.viewmat[1, :3]).tolist()
    fov = 2 * math.atan(0.5 * camera.height / float(camera.K[1, 1]))
    values = [*position.tolist(), unit, *look, *up, fov]
    return Viewpoint(*values)


def camera_of(viewpoint: Viewpoint, width: int, height: int, name: str = "") -> Camera:
    """The camera of a viewpoint that has a direction, for images of this size."""
    values = torch.tensor(astuple(viewpoint), dtype=torch.float64)
    viewmat = looking(eye=values[:3], forward=values[4:7], down=-values[7:10])
    focal = 0.5 * height / math.tan(0.5 * viewpoint.fov)
    K = intrinsics(focal, focal, 0.5 * width, 0.5 * height)
    return Camera(viewmat.float(), K, width, height, name)


@torch.no_grad()
def typical_distance(means: Tensor, places: Sequence[Place], config: AttenuationConfig) -> Tensor:
    """``[N]`` d_i, without unit, >= 0: the distances from one place, or the geometric mean over
    several.

    Places over OUTLIER times as far from the scene's centre as the median place and the median
    Gaussian do not count. ClodError where there is no place.
    """
    if not places:
        raise ClodError(
            "no camera is given, so there is no distance for the dial to fade by; give at least one"
        )
    if len(places) == 1:
        return _from(places[0], means, config)
    logs = torch.zeros_like(means[:, 0])
    places = _without_outliers(means, places)
    for place in places:
        logs += _from(place, means, config).clamp(min=NEAREST).log()
    return (logs / len(places)).exp()


def _without_outliers(means: Tensor, places: Sequence[Place]) -> Sequence[Place]:
    if len(places) < 3:
        return places
    centre = means.median(0).values
    away = torch.stack([(position_of(place, means) - centre).norm() for place in places])
    radius = (means - centre).norm(dim=1).median()
    limit = OUTLIER * torch.maximum(away.median(), radius)
    return [place for place, distance in zip(places, away, strict=True) if bool(distance <= limit)]


def position_of(place: Place, means: Tensor) -> Tensor:
    if isinstance(place, Camera):
        return place.position.to(means)
    return means.new_tensor([place.x, place.y, place.z])


def _from(place: Place, means: Tensor, config: AttenuationConfig) -> Tensor:
    if isinstance(place, Camera):
        return normalized_distances(means, place, config)
    return (means - position_of(place, means)).norm(dim=1) / place.unit
