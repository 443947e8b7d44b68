"""Frame times of dial values, measured so that they can be compared: all of them in turn, several
times.

One pass renders every dial value of every model from every view: a change of the clock rate or the
load meets all. A time is the median over the passes, after a warm-up with the slowest dial value,
and has the range of the passes beside it.
"""

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch

from clod_adapter.cameras import Camera
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.rasterizers import wait_for
from clod_adapter.render import Rendering, render

VIEWS = 3
PASSES = 5
FEWEST = 3
# after which no pass begins, once there are FEWEST; a pass that would take a third of it has one
# view
SECONDS = 10.0
# the warm-up, which ends with the first of them
WARM_FRAMES = 8
WARM_SECONDS = 2.0
NOISY = 0.2  # a larger range of the passes, as a share of the time, is reported

Model = tuple[Gaussians, Sequence[float]]  # and the dial values to time it at


@dataclass(frozen=True)
class FrameTimes:
    """Milliseconds per frame of each dial value of each model.

    Attributes:
        milliseconds: means over the views, medians over the passes.
        ranges: of the passes, between their quartiles.
    """

    milliseconds: tuple[tuple[float, ...], ...]
    ranges: tuple[tuple[float, ...], ...]

    @property
    def notes(self) -> list[str]:
        """A note if the machine was too busy for these times."""
        shares = list[float]()
        for times, ranges in zip(self.milliseconds, self.ranges, strict=True):
            shares += [between / time for time, between in zip(times, ranges, strict=True)]
        middle = statistics.median(shares)
        if middle <= NOISY:
            return []
        return [
            f"frame times are rough: they varied by {middle:.0%}, as this machine was busy with"
            " other work"
        ]


@torch.no_grad()
def time_frames(
    models: Sequence[Model],
    cameras: Sequence[Camera],
    progress: Listener | None = None,
) -> FrameTimes:
    """Times frames from at most three of the cameras, evenly spread."""
    if not cameras:
        raise ClodError("frames a second need a quality table or cameras to time frames from")
    jobs = list[tuple[Gaussians, float]]()
    for model, dials in models:
        model = model.without_empty_bands()
        jobs += [(model, 1.0 if model.sigma_d is None else s) for s in dials]
    slowest = _warm_up(*min(jobs, key=lambda job: job[1]), cameras[0])
    views = cameras[:: -(-len(cameras) // VIEWS)]
    if slowest * len(views) * len(jobs) > SECONDS / FEWEST:
        views = views[len(views) // 2 :][:1]
    began = time.perf_counter()
    passes = list[list[float]]()
    while len(passes) < PASSES and (len(passes) < FEWEST or time.perf_counter() - began < SECONDS):
        seconds = [timed_frame(model, view, s)[1] for view, (model, s) in product(views, jobs)]
        milliseconds_of_jobs = []
        for k in range(len(jobs)):
            milliseconds_of_jobs.append(1e3 * statistics.fmean(seconds[k :: len(jobs)]))
        passes.append(milliseconds_of_jobs)
        tell(progress, Phase.FRAME_TIMES, len(passes), PASSES)
    columns = zip(*passes, strict=True)
    milliseconds = []
    ranges = []
    for _, dials in models:
        quartiles = [statistics.quantiles(next(columns), n=4, method="inclusive") for _ in dials]
        milliseconds.append(tuple(middle for _, middle, _ in quartiles))
        ranges.append(tuple(high - low for low, _, high in quartiles))
    return FrameTimes(tuple(milliseconds), tuple(ranges))


def _warm_up(gaussians: Gaussians, virtual_scale: float, camera: Camera) -> float:
    """Renders until functions are compiled and the clock rate is raised; the last time, seconds."""
    began = time.perf_counter()
    for _ in range(WARM_FRAMES):
        _, taken = timed_frame(gaussians, camera, virtual_scale)
        if time.perf_counter() - began >= WARM_SECONDS:
            break
    return taken


def timed_frame(
    gaussians: Gaussians,
    camera: Camera,
    virtual_scale: float,
) -> tuple[Rendering, float]:
    """A rendering, and the seconds that it took, the device's work included."""
    wait_for(gaussians.means.device)
    began = time.perf_counter()
    rendering = render(gaussians, camera, virtual_scale)
    wait_for(gaussians.means.device)
    return rendering, time.perf_counter() - began
