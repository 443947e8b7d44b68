"""The errors of the levels of a tile set, by which a viewer of 3D Tiles chooses them: lengths.

It shows a tile where its ``geometricError`` g at distance d covers at most a number of pixels, 16 by default:

    g f / d <= 16

with f the focal length in pixels. Two images of which one is the other shifted by e pixels differ by about e times
their slope. So level l is as far from the finest as a shift of

    e_l = |I_l - I_0| / |dI_0|

pixels, with ``|.|`` root mean squares over pixels and channels and ``dI_0`` the mean slope of the image along x and y.
Seen from d this is the length ``e_l d / f``. Its mean over cameras, with d the median distance of the Gaussians in the
image, is the error of the level. Times 16, the default of viewers allows a shift of one pixel.

Source of the rule: 3D Tiles 1.1 (OGC 22-025r4), "Geometric error"; CesiumJS's ``maximumScreenSpaceError`` is 16.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from clod_adapter.calibration import Viewpoint
from clod_adapter.cameras import Camera, spread
from clod_adapter.equation.distances import median_distance
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.formats.tileset import ALLOWED
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import render
from clod_adapter.training.camera_placement import FIELD, HEIGHT, WIDTH

VIEWS = 16  # cameras that errors are measured from


def looking(places: Sequence[Camera | Viewpoint], gaussians: Gaussians) -> list[Camera]:
    """The cameras; a viewpoint has no direction, and looks at the median of the centres."""
    middle = gaussians.means.median(0).values.cpu().double().numpy()
    return [place if isinstance(place, Camera) else _toward(middle, place) for place in places]


def _toward(target: np.ndarray, viewpoint: Viewpoint) -> Camera:
    place = np.array([viewpoint.x, viewpoint.y, viewpoint.z])
    forward = target - place
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12) if forward.any() else np.array([0.0, 0.0, 1.0])
    right = np.cross(np.eye(3)[np.abs(forward).argmin()], forward)
    right /= np.linalg.norm(right)
    viewmat, focal = np.eye(4), WIDTH / 2 / np.tan(np.radians(FIELD) / 2)
    viewmat[:3, :3] = right, np.cross(forward, right), forward
    viewmat[:3, 3] = -viewmat[:3, :3] @ place
    K = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]], dtype=torch.float32)
    return Camera(torch.from_numpy(viewmat).float(), K.float(), WIDTH, HEIGHT)


@torch.no_grad()
def geometric_errors(
    levels: Sequence[Gaussians], cameras: Sequence[Camera], *, progress: Listener | None = None
) -> np.ndarray:
    """``[L]`` float64, world units, ascending from 0, of levels without a dial, the finest first."""
    picked = spread(cameras, VIEWS)
    found = np.zeros((len(picked), len(levels)))
    for done, view in enumerate(picked):
        images = [render(level, view).image.clamp(0, 1) for level in levels]
        slope = max(_slope(images[0]), 1e-6)
        length = median_distance(levels[0].means, view) / float(view.K[0, 0])
        found[done] = [length / slope * float((image - images[0]).square().mean().sqrt()) for image in images]
        tell(progress, Phase.LEVELS, done + 1, len(picked))
    return ALLOWED * np.maximum.accumulate(found.mean(0))  # type: ignore[no-any-return]


def _slope(image: Tensor) -> float:
    """Root mean square of the differences between neighbouring pixels, along x and y."""
    across, down = image.diff(dim=1).square().mean(), image.diff(dim=0).square().mean()
    return float(((across + down) / 2).sqrt())
