"""The error of each level of a tile set as a length, by which 3D Tiles viewers choose levels.

A viewer shows a tile where its ``geometricError`` g at distance d covers at most a number of pixels, 16 by default:

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

from clod_adapter.cameras import Camera
from clod_adapter.equation.distances import median_distance
from clod_adapter.evaluation.level_errors import VIEWS
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.formats.tileset import ALLOWED
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import render


@torch.no_grad()
def geometric_errors(
    levels: Sequence[Gaussians], cameras: Sequence[Camera], *, progress: Listener | None = None
) -> np.ndarray:
    """``[L]`` float64, >= 0, world units: 0 for the finest level, ascending.

    Args:
        levels: without a dial, the finest first.
        cameras: at least one; VIEWS of them are used, evenly chosen.
        progress: called in ``Phase.LEVELS`` after each camera.
    """
    picked = np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round().astype(int)
    found = np.zeros((len(picked), len(levels)))
    for done, view in enumerate(cameras[k] for k in picked):
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
