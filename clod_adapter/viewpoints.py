"""One distance for each Gaussian, where no camera comes with the file: a plain file, and an order of rows, have one.

The dial fades a Gaussian by its normalised distance ``d'`` from the camera. Over the cameras that are known that is

    d_i = exp(mean over v of log d'_iv),    d'_iv = |mu_i - c_v| / D_v

with ``mu_i`` the centre of Gaussian i and ``c_v`` the camera's, both in world units, and ``D_v`` what the normaliser
divides by there (``attenuation.normalizing_distance``). Cameras that do not see a Gaussian count as the others do: that
measured as well as a mean over those that see it, or one weighted by what it is worth there, and needs no frustum.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from clod_adapter.attenuation import normalized_distances, normalizing_distance
from clod_adapter.calibration import Viewpoint
from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError

NEAREST = 1e-6  # the least d' that the mean takes: one camera in a centre does not decide alone


@torch.no_grad()
def viewpoint_of(camera: Camera, means: Tensor, config: AttenuationConfig) -> Viewpoint:
    """The viewpoint of a camera that looks at Gaussians with centres ``means [N, 3]``, world units."""
    position = camera.position.to(means)
    unit = normalizing_distance((means - position).norm(dim=1), means, camera, config)
    x, y, z = position.double().tolist()
    return Viewpoint(x, y, z, float(unit))


@torch.no_grad()
def typical_distance(means: Tensor, places: Sequence[Camera | Viewpoint], config: AttenuationConfig) -> Tensor:
    """``[N]`` d_i, without unit, >= 0: of one place the distances from there, of several their geometric mean.

    Args:
        means: ``[N, 3]`` world units.
        places: at least one.

    Raises:
        ClodError: there is no place.
    """
    if not places:
        raise ClodError("no camera is given, so there is no distance for the dial to fade by; give at least one")
    if len(places) == 1:
        return _distances(means, places[0], config)
    logs = torch.zeros_like(means[:, 0])
    for place in places:
        logs += _distances(means, place, config).clamp(min=NEAREST).log()
    return (logs / len(places)).exp()


def _distances(means: Tensor, place: Camera | Viewpoint, config: AttenuationConfig) -> Tensor:
    if isinstance(place, Camera):
        return normalized_distances(means, place, config)
    centre = torch.tensor([place.x, place.y, place.z], dtype=means.dtype, device=means.device)
    return (means - centre).norm(dim=1) / place.unit
