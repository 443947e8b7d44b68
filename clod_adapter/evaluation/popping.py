"""Popping: whether the image changes evenly or in jumps as the dial turns or the camera moves.

Neighbouring steps of a sweep are compared *from one camera*, so that the camera's own motion does
not count. With ``I_c(k)`` the image, clamped to [0, 1], from camera c with the opacities and scales
of step k, step k changes it by

    delta_k = I_c(k+1) - I_c(k)      c the camera of step k+1
    change_k = 255 rms(delta_k)      root mean square over pixels and channels, in levels of 255

A fade changes the image in proportion to the length of the step, a jump by a constant amount:

    ratio       = max change / mean change
    persistence = max change / max change over 2 steps  (I_c(k+1) - I_c(k-1))

The ratio is 1 if all steps are equal, and n for one switch within n steps. The persistence is 1/2
for a fade, 1 for a jump or a flicker, about 0.7 if many small jumps at different places add up in
every step.

``max change (2 - 1 / persistence)`` approximates the largest change in the limit of short steps. A
single Gaussian hardly changes the root mean square, so the largest change of a pixel is measured
too.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import fmean

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from clod_adapter._support.arrays import float64_array
from clod_adapter.cameras import Camera
from clod_adapter.config import require
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.rasterizers import for_device
from clod_adapter.render import render


@dataclass(frozen=True)
class Popping:
    """Changes of the image over a sweep, in steps of equal length; changes are in levels of 255.

    ``mean`` and ``largest`` are changes of a step, ``at`` the end of the largest one, as a dial
    value or a share of the camera path; ``pixel`` is the largest change of one channel of one
    pixel. Ratios are NaN if nothing changes.
    """

    steps: int
    mean: float
    largest: float
    at: float
    ratio: float
    persistence: float
    pixel: float
    pixel_at: float
    pixel_persistence: float
    changes: tuple[float, ...]


@torch.no_grad()
def sweep(
    show: Callable[[int, int], Tensor],
    positions: Sequence[float],
    progress: Listener | None = None,
) -> Popping:
    """Measures images: ``show(k, j)`` is that ``[H, W, 3]`` from the camera of step k with the
    Gaussians of step j.
    """
    require(len(positions) >= 3, "number of positions", len(positions), "at least 3")
    once = []
    twice = []
    for k in range(1, len(positions)):
        new = show(k, k).clamp(0, 1)
        once.append(_change(new - show(k, k - 1).clamp(0, 1)))
        if k >= 2:
            twice.append(_change(new - show(k, k - 2).clamp(0, 1)))
        tell(progress, Phase.POPPING, k, len(positions) - 1)
    changes, pixels = zip(*once, strict=True)
    wide_changes, wide_pixels = zip(*twice, strict=True)
    largest = max(changes)
    pixel = max(pixels)
    mean = fmean(changes)
    return Popping(
        steps=len(changes),
        mean=mean,
        largest=largest,
        at=float(positions[changes.index(largest) + 1]),
        ratio=_ratio(largest, mean),
        persistence=_ratio(largest, max(largest, *wide_changes)),
        pixel=pixel,
        pixel_at=float(positions[pixels.index(pixel) + 1]),
        pixel_persistence=_ratio(pixel, max(pixel, *wide_pixels)),
        changes=changes,
    )


def dial_popping(
    gaussians: Gaussians,
    camera: Camera,
    max_sv: float,
    *,
    steps: int = 200,
    progress: Listener | None = None,
) -> Popping:
    """Turns the dial from 1 to ``max_sv`` in steps of equal ratio, for one camera."""
    require(1 < max_sv < math.inf, "max_sv", max_sv, "above 1 and finite")
    positions = [max_sv ** (k / steps) for k in range(steps + 1)]
    gaussians = gaussians.without_empty_bands()
    # Each image is used three times.
    picture = lru_cache(maxsize=3)(lambda j: render(gaussians, camera, positions[j]).image)
    return sweep(lambda _, j: picture(j), positions, progress)


def path_popping(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    virtual_scale: float,
    *,
    steps: int = 200,
    progress: Listener | None = None,
) -> Popping:
    """Moves through the ``cameras`` in steps of equal length (``path``), at one dial value."""
    gaussians = gaussians.without_empty_bands()
    views = path(cameras, steps)
    rasterizer = for_device(gaussians.means.device)

    def picture(k: int, j: int) -> Tensor:
        return rasterizer.draw(gaussians, views[k], virtual_scale, seen_from=views[j])[0]

    return sweep(picture, [k / steps for k in range(steps + 1)], progress)


def path(cameras: Sequence[Camera], steps: int) -> list[Camera]:
    """``steps + 1`` cameras at equal distances along the path through all of them, interpolated
    linearly and by slerp.

    If no centre moves, each rotation takes the same number of steps. Size and intrinsics are the
    first camera's.
    """
    require(steps >= 2, "steps", steps, "at least 2")
    if len(cameras) < 2:
        raise ClodError(f"a camera path needs at least two cameras, not {len(cameras)}")
    first = cameras[0]
    viewmats = np.stack([float64_array(camera.viewmat) for camera in cameras])
    poses = np.linalg.inv(viewmats)
    centres = poses[:, :3, 3]
    lengths = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    lengths = np.maximum(lengths, 1e-9 * lengths.sum() or 1.0)
    places = np.concatenate([[0.0], lengths.cumsum()])
    at = np.linspace(0, places[-1], steps + 1)
    rotations = Slerp(places, Rotation.from_matrix(poses[:, :3, :3]))
    moved = np.tile(np.eye(4), (steps + 1, 1, 1))
    moved[:, :3, :3] = rotations(at).as_matrix()
    for axis in range(3):
        moved[:, axis, 3] = np.interp(at, places, centres[:, axis])
    path_viewmats = torch.from_numpy(np.linalg.inv(moved)).to(first.viewmat)
    return [replace(first, viewmat=viewmat) for viewmat in path_viewmats]


def _change(delta: Tensor) -> tuple[float, float]:
    """Root mean square, and largest absolute value, in levels of 255."""
    root_mean_square = float(delta.square().mean().sqrt())
    largest = float(delta.abs().max())
    return 255 * root_mean_square, 255 * largest


def _ratio(numerator: float, denominator: float) -> float:
    return numerator / denominator if denominator > 0 else math.nan
