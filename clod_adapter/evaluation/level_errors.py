"""The errors of the levels of a tile set, lengths by which a viewer of 3D Tiles chooses them.

It shows a tile whose ``geometricError`` g at distance d, with a focal length of f pixels, covers few enough of them:

    g f / d <= 16           3D Tiles 1.1 (OGC 22-025r4), "Geometric error"; CesiumJS's ``maximumScreenSpaceError``

An image that is shifted by e pixels changes by about e times its slope, so level l is off by e_l pixels:

    e_l = |I_l - I_0| / |dI_0|

``|.|`` are root mean squares over pixels and channels, ``dI_0`` the mean slope of the finest level along x and y. The
error, 16 times the mean of ``e_l d / f`` over cameras, d the median distance in the image, allows a shift of one pixel.
"""

from collections.abc import Sequence

import numpy as np
import torch

from clod_adapter.cameras import Camera, spread
from clod_adapter.equation.distances import Place, camera_of, median_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.formats.tileset import ALLOWED
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import render
from clod_adapter.training.camera_placement import HEIGHT, WIDTH

VIEWS = 16  # cameras that errors are measured from


def looking(places: Sequence[Place]) -> list[Camera]:
    """The cameras, those of viewpoints in the size of placed ones; without viewpoints that have no direction."""
    known = [place for place in places if isinstance(place, Camera) or place.fov > 0]
    return [place if isinstance(place, Camera) else camera_of(place, WIDTH, HEIGHT) for place in known]


@torch.no_grad()
def geometric_errors(
    levels: Sequence[Gaussians], cameras: Sequence[Camera], *, progress: Listener | None = None
) -> np.ndarray:
    """``[L]`` float64, world units, ascending from 0, of levels without a dial, the finest first."""
    if not cameras:
        raise ClodError("the cameras of the file have no direction to measure its levels in; give --images")
    picked = spread(cameras, VIEWS)
    found = np.zeros((len(picked), len(levels)))
    for done, view in enumerate(picked):
        images = [render(level, view).image.clamp(0, 1) for level in levels]
        across, down = (images[0].diff(dim=dim).square().mean() for dim in (1, 0))
        slope = max(float(((across + down) / 2).sqrt()), 1e-6)
        length = median_distance(levels[0].means, view) / float(view.K[0, 0])
        found[done] = [length / slope * float((image - images[0]).square().mean().sqrt()) for image in images]
        tell(progress, Phase.LEVELS, done + 1, len(picked))
    return ALLOWED * np.maximum.accumulate(found.mean(0))  # type: ignore[no-any-return]
