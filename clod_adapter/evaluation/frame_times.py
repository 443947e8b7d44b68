"""Frame times of dial values, measured so that they can be compared: all of them in turn, several
times.

One pass renders every dial value of every model from every view: a change of the clock rate or the
load meets all. A time is the median over the passes, after a warm-up with the slowest dial value.
Where it is above that of the dial value before it, which draws more, and the passes do not agree on
that, both get their mean.
"""

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, product

import torch

from clod_adapter.cameras import Camera
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.rasterizers import wait_for
from clod_adapter.render import Rendering, render

VIEWS, PASSES, FEWEST = 3, 5, 3
# after which no pass begins, once there are FEWEST; a pass that would take a third of it has one
# view
SECONDS = 10.0
# the warm-up ends with two frames whose times differ by a tenth
WARM_FRAMES, WARM_SECONDS, STEADY = 8, 2.0, 0.1
RISE = 0.05  # an increase of the time in every pass is real if it is at least this large
NOISY = 0.2  # a larger spread of the passes is reported

Model = tuple[Gaussians, Sequence[float]]  # and the dial values, ascending, to time it at


@dataclass(frozen=True)
class FrameTimes:
    """Milliseconds per frame of each dial value of each model: means over the views, medians over
    the passes.

    ``spread`` is the interquartile range of the passes over their median; the median over the dial
    values.
    """

    milliseconds: tuple[tuple[float, ...], ...]
    spread: float

    @property
    def notes(self) -> list[str]:
        """A note if the machine was too busy for these times."""
        if self.spread <= NOISY:
            return []
        return [
            f"frame times are rough: they varied by {self.spread:.0%}, as this machine was busy"
            " with other work"
        ]


@torch.no_grad()
def time_frames(
    models: Sequence[Model], cameras: Sequence[Camera], progress: Listener | None = None
) -> FrameTimes:
    """Times frames from at most three of the cameras, evenly spread; the first dial value of all is
    the slowest.
    """
    if not cameras:
        raise ClodError("frames a second need a calibration or cameras to time frames from")
    jobs = list[tuple[Gaussians, float]]()
    for model, dials in models:
        model = model.without_empty_bands()
        jobs += [(model, 1.0 if model.sigma_d is None else s) for s in dials]
    slowest = _warm_up(*jobs[0], cameras[0])
    views = cameras[:: -(-len(cameras) // VIEWS)]
    if slowest * len(views) * len(jobs) > SECONDS / FEWEST:
        views = views[len(views) // 2 :][:1]
    began, passes = time.perf_counter(), list[list[float]]()
    while len(passes) < PASSES and (len(passes) < FEWEST or time.perf_counter() - began < SECONDS):
        seconds = [timed_frame(model, view, s)[1] for view, (model, s) in product(views, jobs)]
        passes.append([1e3 * statistics.fmean(seconds[k :: len(jobs)]) for k in range(len(jobs))])
        tell(progress, Phase.FRAME_TIMES, len(passes), PASSES)
    milliseconds, first = [], 0
    for _, dials in models:
        end = first + len(dials)
        milliseconds.append(tuple(settled([times[first:end] for times in passes])))
        first = end
    spreads = []
    for column in zip(*passes, strict=True):
        low, middle, high = statistics.quantiles(column, n=4, method="inclusive")
        spreads.append((high - low) / middle)
    return FrameTimes(tuple(milliseconds), statistics.median(spreads))


def settled(passes: Sequence[Sequence[float]]) -> list[float]:
    """``[K]`` medians of ``[P, K]`` times; without increases from one to the next on which the
    passes do not agree.
    """
    levels = list[list[float]]()  # of equal times
    for k, column in enumerate(zip(*passes, strict=True)):
        levels.append([statistics.median(column)])
        # fewer Gaussians, which have grown
        if not k or all(each[k] > (1 + RISE) * each[k - 1] for each in passes):
            start = len(levels) - 1
        while len(levels) > start + 1 and statistics.fmean(levels[-1]) > statistics.fmean(
            levels[-2]
        ):
            levels[-2:] = [levels[-2] + levels[-1]]
    means = [[statistics.fmean(level)] * len(level) for level in levels]
    return list(chain.from_iterable(means))


def _warm_up(gaussians: Gaussians, virtual_scale: float, camera: Camera) -> float:
    """Renders until the times are steady, with compiled functions and a raised clock rate; the last
    time, seconds.
    """
    began, before = time.perf_counter(), 0.0
    for _ in range(WARM_FRAMES):
        taken = timed_frame(gaussians, camera, virtual_scale)[1]
        if abs(taken - before) <= STEADY * taken or time.perf_counter() - began > WARM_SECONDS:
            break
        before = taken
    return taken


def timed_frame(
    gaussians: Gaussians, camera: Camera, virtual_scale: float
) -> tuple[Rendering, float]:
    """A rendering, and the seconds that it took, the device's work included."""
    wait_for(gaussians.means.device)
    began = time.perf_counter()
    rendering = render(gaussians, camera, virtual_scale)
    wait_for(gaussians.means.device)
    return rendering, time.perf_counter() - began
