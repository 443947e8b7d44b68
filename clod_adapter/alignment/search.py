"""Searches the frame of a checkpoint that does not fit its cameras.

Known frames are ranked by the correlation of small renders with the photographs. If none fits, a
scale and an offset are searched. The result is measured by ``check_alignment`` and given only if it
fits clearly better.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from clod_adapter.alignment.check import (
    CLEAR,
    DOUBTFUL,
    Alignment,
    check_alignment,
    compare_renders,
    correlation,
)
from clod_adapter.alignment.frames import Frame, focus_of, known_frames
from clod_adapter.cameras import Camera, Scene, View, in_its_unit, spread
from clod_adapter.gaussians import Gaussians

COARSE = (72, 20_000)  # of the small renders: pixels of width, Gaussians
# For the found place: the same, and the first and the last step as shares of the cameras' distance.
FINER = ((240, 20_000, (0.01, 0.001)), (480, 60_000, (0.001, 0.0001)))
SMALL_RENDERS = 4  # number of small renders
SCALES = [10 ** (k / 12) for k in range(-24, 25)]  # a hundredth to a hundred, in steps of 21 %
LOWEST_CORRELATION = 0.5  # after the coarse search; below it the search ends
MOST_TRIALS = 80  # of a pattern search, which usually takes a dozen steps
BETTER_THAN_MEAN = 1.5  # dB


@dataclass(frozen=True)
class Guess:
    """A frame in which the checkpoint fits."""

    frame: Frame
    psnr: float  # pooled, of the renders in that frame
    # whether the PSNR is as far above that of the mean colours as that of files in their own frame
    clear: bool


@torch.no_grad()
def guess_frame(
    gaussians: Gaussians,
    views: Sequence[View],
    alignment: Alignment,
    points: Tensor | None = None,
    cameras: Sequence[Camera] = (),
) -> Guess | None:
    """A frame whose PSNR is BETTER_THAN_MEAN dB above the photographs' mean colours and CLEAR dB
    above ``alignment``.

    ``cameras`` are all of the scene's, if ``views`` are not, and ``points`` those of its model.
    """
    if len(gaussians) == 0 or alignment.views == 0:
        return None
    cameras = cameras or [view.camera for view in views]
    viewmats = torch.stack([camera.viewmat.double() for camera in cameras])
    score = _small(gaussians, views, *COARSE)

    def measured(frame: Frame) -> Guess | None:
        psnr = check_alignment(gaussians, views_in(views, frame)).psnr
        enough = max(alignment.mean_colour_psnr + BETTER_THAN_MEAN, alignment.psnr + CLEAR)
        if not psnr >= enough:
            return None
        return Guess(frame, psnr, psnr >= alignment.mean_colour_psnr + DOUBTFUL)

    guess = measured(max(known_frames(viewmats, points), key=score))
    if guess:
        return guess
    searched = _search(gaussians, views, score, viewmats)
    return measured(searched) if searched else None


def camera_in(camera: Camera, frame: Frame) -> Camera:
    """The camera in the file's frame."""
    viewmat = frame.of(camera.viewmat[None])[0].to(camera.viewmat)
    return replace(camera, viewmat=viewmat, near=camera.near / frame.scale)


def views_in(views: Sequence[View], frame: Frame) -> tuple[View, ...]:
    """The photographs with their cameras in the file's frame."""
    return tuple(view.at(camera_in(view.camera, frame)) for view in views)


def scene_in(scene: Scene, frame: Frame) -> Scene:
    """The scene with its cameras in the file's frame, and the near planes of that frame's unit."""
    train = views_in(scene.train, frame)
    test = views_in(scene.test, frame)
    return in_its_unit(replace(scene, train=train, test=test))


def _small(
    gaussians: Gaussians,
    views: Sequence[View],
    width: int,
    most: int,
) -> Callable[[Frame], float]:
    """The correlation of small photographs with renders, in a frame, of the ``most`` Gaussians that
    cover most.
    """
    shrunk = [_shrunk(view, width) for view in spread(views, SMALL_RENDERS)]
    if len(gaussians) > most:
        log_areas = gaussians.log_scales.topk(2, dim=1).values.sum(1)
        cover = F.logsigmoid(gaussians.opacity_logits) + log_areas
        gaussians = gaussians.select(cover.topk(most).indices)
    return lambda frame: correlation(compare_renders(gaussians, views_in(shrunk, frame)))


def _search(
    gaussians: Gaussians,
    views: Sequence[View],
    score: Callable[[Frame], float],
    viewmats: Tensor,
) -> Frame | None:
    """The best scale and offset; None if no correlation reaches LOWEST_CORRELATION.

    Climbs to the nearest maximum from the best scale about the origin, and from the best one about
    the point that most cameras look at, with the median of the Gaussians moved there.
    """
    middle = gaussians.means.double().median(dim=0).values.cpu()  # where cameras are
    centres = torch.linalg.inv(viewmats)[:, :3, 3]
    focus = focus_of(viewmats)
    unit = float((centres - focus).norm(dim=1).quantile(0.5).clamp(min=1e-9))
    climbs = []
    for towards in (0.0, 1.0):
        places = [_placed(scale, towards * (focus - scale * middle)) for scale in SCALES]
        start = max(places, key=score)
        climbs.append(_climb(score, start, focus, unit, (0.1, 0.02)))
    best, frame = max(climbs, key=lambda climb: climb[0])
    if not best >= LOWEST_CORRELATION:
        return None
    for width, most, steps in FINER:
        score = _small(gaussians, views, width, most)
        _, frame = _climb(score, frame, focus, unit, steps)
    return frame


def _placed(scale: float, offset: Tensor) -> Frame:
    by = ", ".join(f"{value:.3g}" for value in offset.tolist())
    larger = f"{scale:.3g} times as large and " if abs(scale - 1) > 0.02 else ""
    description = f"the file should be {larger}moved by ({by}): export it in the cameras' frame"
    return Frame("scale and offset", description, scale=scale, offset=offset)


def _climb(
    score: Callable[[Frame], float],
    frame: Frame,
    focus: Tensor,
    unit: float,
    steps: tuple[float, float],
) -> tuple[float, Frame]:
    """Pattern search for the nearest maximum; ``steps`` are the first and the last step, shares of
    ``unit``.

    Moves along the axes, and scales about the point that the cameras look at, which keeps it in
    view.
    """
    step, smallest = steps
    best = score(frame)
    trials = 0
    while step >= smallest and trials < MOST_TRIALS:
        moves = step * unit * torch.eye(3, dtype=focus.dtype)
        neighbours = []
        for move in (*moves, *-moves):
            neighbours.append(_placed(frame.scale, frame.offset + move))
        for factor in (1 + step, 1 / (1 + step)):
            offset = focus - factor * (focus - frame.offset)
            neighbours.append(_placed(frame.scale * factor, offset))
        for neighbour in neighbours:
            trials += 1
            value = score(neighbour)
            if value > best:
                best = value
                frame = neighbour
                break
        else:
            step /= 2
    return best, frame


def _shrunk(view: View, width: int) -> View:
    """The photograph and its camera at a smaller width, by area averages."""
    camera = view.camera
    if camera.width <= width:
        return view
    height = max(1, round(camera.height * width / camera.width))
    pixels = view.image.permute(2, 0, 1).float()
    planes = F.adaptive_avg_pool2d(pixels, (height, width))
    image = planes.permute(1, 2, 0).round().to(torch.uint8)
    return View(camera.resized(width, height), image)
