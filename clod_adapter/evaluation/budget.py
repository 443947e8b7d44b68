"""Budgets: the dial value for a number of Gaussians, a PSNR drop, or a frame rate.

- A count needs no measurement: from one camera a Gaussian is kept between two dial values, and the
  count is bisected. Exact unless several Gaussians begin or end at one dial value.
- PSNR is read from the quality table that is stored with the file (``quality_table.py``).
- Frame rates depend on the machine, the image size and the load: frames are timed, from cameras.
  The table's times are used only where they are passed in, or (``clod-adapt export``) where nothing
  can be timed.

A budget that s = 1 meets gives 1 and a note. Only a count is met beyond ``max_sv``, where nothing
was trained, with a note.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import number, require
from clod_adapter.equation.attenuation import dial, kept_between, smallest_dial
from clod_adapter.equation.distances import Place, typical_distance
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Listener
from clod_adapter.quality_table import QualityTable, crossing

TIMED_DIALS = 6
BEYOND = 1e6  # times max_sv, where the search for a count ends
PRECISION = 1e-12  # of the dial value that meets a count


@dataclass(frozen=True)
class DialValue:
    """The dial value that meets a budget.

    Attributes:
        virtual_scale: the dial s, at least 1.
        note: one line where the budget has no effect, or is met beyond max_sv alone; else empty.
    """

    virtual_scale: float
    note: str = ""


def dial_for(
    gaussians: Gaussians,
    *,
    keep: float | None = None,
    psnr_drop: float | None = None,
    fps: float | None = None,
    cameras: Sequence[Place] = (),
    quality_table: QualityTable | None = None,
    baked: bool = False,
) -> DialValue:
    """The smallest dial value that meets one budget: the best quality within it.

    Args:
        gaussians: with a dial.
        keep: largest number of Gaussians: in the view of one camera, or the mean over several.
        psnr_drop: dB below the quality table's PSNR at s = 1; gives the largest dial value before
            PSNR first is lower.
        fps: frames per second. The times of a quality table are used as they are, whatever machine
            and image size they are from (``quality_table.machine``, ``width``, ``height``); without
            one, ``cameras`` are timed.
        cameras: for ``keep`` and ``fps``; ``fps`` needs whole cameras to render from.
        quality_table: for ``psnr_drop`` and ``fps``; ``load(path).quality_table``.
        baked: ``keep`` counts the Gaussians that ``bake`` keeps for the cameras.

    Raises:
        ClodError: not exactly one budget, a budget that is not positive, no dial, no data for the
            budget, a count that no dial value meets, or a frame rate that max_sv does not; the
            message then gives what is reached.

    Example:
        >>> model = clod.load("model.ply")
        >>> dial = clod.dial_for(model.gaussians, keep=2000, cameras=model.viewpoints)
        >>> print(dial.virtual_scale, dial.note)
    """
    budgets = {"keep": keep, "psnr_drop": psnr_drop, "fps": fps}
    given = {name: value for name, value in budgets.items() if value is not None}
    if len(given) != 1:
        raise ClodError(
            f"dial_for needs exactly one of keep, psnr_drop and fps, {len(given)} are given"
        )
    _check_sources(gaussians, cameras)
    ((name, value),) = given.items()
    require(0 < number(value) < math.inf, name, value, "a positive, finite number")
    if keep is not None:
        return _for_count(gaussians, cameras, baked, keep)
    if psnr_drop is not None:
        return _for_psnr_drop(quality_table, psnr_drop)
    if quality_table:
        times = [(row.virtual_scale, row.frame_ms) for row in quality_table.rows]
    else:
        whole = [camera for camera in cameras if isinstance(camera, Camera)]
        times, _ = frame_times(gaussians, whole)
    return dial_for_times(times, value)


def _check_sources(gaussians: Gaussians, cameras: Sequence[Place]) -> None:
    require(isinstance(gaussians, Gaussians), "gaussians", type(gaussians), "Gaussians")
    places = isinstance(cameras, Sequence) and all(isinstance(each, Place) for each in cameras)
    if cameras and not places:
        raise ClodError(
            "cameras must be a list of cameras or viewpoints; of views [view.camera for view in"
            " views]"
        )
    if gaussians.sigma_d is None:
        raise ClodError(
            "the Gaussians have no sigma_d, so no dial value meets a budget; adapt them first"
        )


def dial_for_times(times: Sequence[tuple[float, float]], fps: float) -> DialValue:
    """The smallest dial value from which frames take at most ``1000 / fps`` ms, by (dial value, ms)
    that ascend.
    """
    dials, taken = zip(*times, strict=True)
    found = crossing(dials, taken, 1e3 / fps)
    if found is None:
        raise ClodError(
            f"{fps:g} frames a second are out of reach: at s = {dials[-1]:g}, the largest dial"
            f" value it was trained for, a frame takes {taken[-1]:.1f} ms, {1e3 / taken[-1]:.0f} a"
            " second"
        )
    if found == dials[0]:
        return DialValue(1.0, f"s = 1 draws {1e3 / taken[0]:.0f} frames a second already")
    return DialValue(found)


def frame_times(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    progress: Listener | None = None,
) -> tuple[list[tuple[float, float]], list[str]]:
    """Measures milliseconds per frame at six dial values up to max_sv, in even steps of log s; and
    notes on that.
    """
    assert gaussians.attenuation is not None
    max_sv = gaussians.attenuation.max_sv
    virtual_scales = sorted({max_sv ** (k / (TIMED_DIALS - 1)) for k in range(TIMED_DIALS)})
    found = time_frames([(gaussians, virtual_scales)], cameras, progress)
    return list(zip(virtual_scales, found.milliseconds[0], strict=True)), found.notes


def _for_psnr_drop(quality_table: QualityTable | None, drop: float) -> DialValue:
    if quality_table is None:
        raise ClodError("a PSNR drop needs the quality table that adapting stores with the file")
    rows = quality_table.rows
    least = rows[0].psnr - drop
    for row, following in pairwise(rows):
        if following.psnr < least:  # PSNR is linear in log s
            share = (row.psnr - least) / (row.psnr - following.psnr)
            ratio = following.virtual_scale / row.virtual_scale
            return DialValue(row.virtual_scale * ratio**share)
    lost = rows[0].psnr - rows[-1].psnr
    largest = rows[-1].virtual_scale
    note = f"only {lost:.2f} dB are lost at s = {largest:g}, the largest dial value measured"
    return DialValue(largest, note)


@torch.no_grad()
def _for_count(
    gaussians: Gaussians,
    cameras: Sequence[Place],
    baked: bool,
    keep: float,
) -> DialValue:
    """Counts Gaussians at their distances from each camera, or with ``baked`` at one distance over
    all cameras.
    """
    config = gaussians.attenuation
    assert config is not None
    views = [cameras] if baked or not cameras else [[camera] for camera in cameras]
    wanted = math.floor(keep * len(views))

    @lru_cache(maxsize=1)  # all at once would be views times Gaussians
    def kept_in(k: int) -> Callable[[float], Tensor]:
        distances = typical_distance(gaussians.means, views[k], config)
        if config.form == "paper":  # whose cut depends on opacity
            return lambda s: dial(gaussians, distances, s).keep
        begin, end = kept_between(gaussians, distances, baked)
        return lambda s: (begin < s) & (s < end)

    def count(virtual_scale: float) -> int:
        return sum(int(kept_in(k)(virtual_scale).sum()) for k in range(len(views)))

    most = count(1.0)
    if wanted == most:
        return DialValue(1.0)
    if wanted > most:
        note = f"s = 1 keeps {most / len(views):,.0f} of {gaussians.whole:,} already"
        return DialValue(1.0, note)
    largest = config.max_sv
    note = ""
    if wanted < count(largest):
        note = f"beyond s = {largest:g}, the largest dial value it was trained for"
        largest *= BEYOND
        fewest = count(largest)
        if fewest > wanted:
            raise ClodError(
                f"{keep:,.0f} Gaussians are out of reach: {fewest / len(views):,.0f} remain at any"
                " dial value"
            )
    found = smallest_dial(lambda s: count(s) <= wanted, 1.0, largest, PRECISION)
    return DialValue(found, note)


@torch.no_grad()
def mean_kept(gaussians: Gaussians, cameras: Sequence[Camera], virtual_scale: float) -> float:
    """Gaussians kept at a dial value, mean over the cameras; without rendering."""
    return fmean(int(dial(gaussians, camera, virtual_scale).keep.sum()) for camera in cameras)


def matching_dial(gaussians: Gaussians, cameras: Sequence[Camera], count: float) -> float:
    """The dial value that keeps ``count`` on average, clamped to [1, max_sv]; 1 without a dial."""
    if gaussians.attenuation is None:
        return 1.0
    try:
        solved = dial_for(gaussians, keep=max(count, 1), cameras=cameras)
        return min(solved.virtual_scale, gaussians.attenuation.max_sv)
    except ClodError:  # out of reach
        return gaussians.attenuation.max_sv
