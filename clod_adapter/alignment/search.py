"""Searches the frame of a checkpoint that does not fit its cameras.

Known frames (``frames.known_frames``) are ranked by the correlation of small renders of the largest Gaussians with the
photographs. If none fits, a scale and an offset are searched. The result is measured by ``check_alignment`` and
reported only if it fits clearly better.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from clod_adapter.alignment.check import CLEAR, Alignment, check_alignment, compare_renders
from clod_adapter.alignment.frames import Frame, centres_of, focus_of, into_file, known_frames
from clod_adapter.cameras import View
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import spread

MOST_GAUSSIANS = 20_000
WIDTH, FINE_WIDTH = 72, 240  # of the small renders, pixels
VIEWS = 4  # number of small renders
SCALES = [10 ** (k / 12) for k in range(-24, 25)]  # a hundredth to a hundred, in steps of 21 %
LOWEST_CORRELATION = 0.5  # after the coarse search; below it the search ends
MOST_TRIALS = 80  # of a pattern search, which usually takes a dozen steps
BETTER_THAN_MEAN = 1.5  # dB


@dataclass(frozen=True)
class Guess:
    """A frame in which the checkpoint fits.

    Attributes:
        description: cause and remedy, for messages.
        psnr: dB, pooled, of the renders in that frame.
    """

    description: str
    psnr: float


@torch.no_grad()
def guess_frame(
    gaussians: Gaussians, views: Sequence[View], found: Alignment, points: Tensor | None = None
) -> Guess | None:
    """A frame that explains the photographs clearly better than that of the cameras; None if none was found.

    Its PSNR must be BETTER_THAN_MEAN dB above the photographs' mean colours and CLEAR dB above ``found``.

    Args:
        views: all views, because trainers normalize by all cameras.
        found: result of ``check_alignment`` for these views.
        points: ``[M, 3]`` the scene's points, world units.
    """
    if len(gaussians) == 0 or found.views == 0:
        return None
    viewmats = torch.stack([view.camera.viewmat.double() for view in views])
    small = _Stage(gaussians, views, WIDTH)

    def measured(frame: Frame) -> Guess | None:
        psnr = check_alignment(gaussians, _moved(views, frame.viewmats)).psnr
        enough = max(found.mean_colour_psnr + BETTER_THAN_MEAN, found.psnr + CLEAR)
        return Guess(frame.description, psnr) if psnr >= enough else None

    known = measured(max(known_frames(viewmats, points), key=lambda frame: small.score(frame.viewmats)))
    if known:
        return known
    searched = _search(small, _Stage(gaussians, views, FINE_WIDTH), viewmats)
    return measured(searched) if searched else None


class _Stage:
    """Small renders of the Gaussians that cover most, compared with small photographs."""

    def __init__(self, gaussians: Gaussians, views: Sequence[View], width: int):
        chosen = spread(range(len(views)), VIEWS)
        self.index = torch.tensor(list(chosen))
        self.views = [_shrunk(views[k], width) for k in chosen]
        self.middle = gaussians.means.double().median(dim=0).values.cpu()  # where cameras are
        if len(gaussians) > MOST_GAUSSIANS:
            cover = F.logsigmoid(gaussians.opacity_logits) + gaussians.log_scales.topk(2, dim=1).values.sum(1)
            gaussians = gaussians.select(cover.topk(MOST_GAUSSIANS).indices)
        self.gaussians = gaussians

    def score(self, viewmats: Tensor) -> float:
        """Correlation in [-1, 1] of the photographs with renders from these poses (``[V, 4, 4]``, of all views)."""
        moved = _moved(self.views, viewmats[self.index])
        rows = [row for view in moved if (row := compare_renders(self.gaussians, view)) is not None]
        if not rows:
            return -1.0
        _, _, constant, rendered, shared = torch.stack(rows).sum(0).tolist()
        return shared / math.sqrt(constant * rendered) if rendered > 0 else 0.0


def _search(small: _Stage, fine: _Stage, viewmats: Tensor) -> Frame | None:
    """The best scale and offset; None if no correlation reaches LOWEST_CORRELATION.

    Starts from the best scale about the origin, and from the best one about the point that the cameras look at with the
    median of the Gaussians moved there; climbs from each to the nearest maximum of the correlation.
    """
    focus = focus_of(viewmats)
    unit = float((centres_of(viewmats) - focus).norm(dim=1).quantile(0.5).clamp(min=1e-9))
    found = []
    for towards in (0.0, 1.0):
        places = [_Place(scale, towards * (focus - scale * small.middle)) for scale in SCALES]
        place = max(places, key=lambda p: small.score(p.seen_from(viewmats)))
        found.append(_climb(small, viewmats, place, focus, unit, (0.1, 0.02)))
    score, place = max(found, key=lambda pair: pair[0])
    if score < LOWEST_CORRELATION:
        return None
    _, place = _climb(fine, viewmats, place, focus, unit, (0.01, 0.001))
    return Frame(place.description(unit), place.seen_from(viewmats))


@dataclass(frozen=True)
class _Place:
    """``x_cameras = scale x_file + offset``."""

    scale: float
    offset: Tensor

    def seen_from(self, viewmats: Tensor) -> Tensor:
        return into_file(viewmats, torch.eye(3, dtype=viewmats.dtype), self.scale, self.offset)

    def neighbours(self, step: float, focus: Tensor, unit: float) -> list[_Place]:
        """Moves along the axes, and scales about the point that the cameras look at, which keeps it in view."""
        axes = torch.eye(3, dtype=focus.dtype)
        moves = [_Place(self.scale, self.offset + sign * step * unit * axis) for axis in axes for sign in (1, -1)]
        factors = (1 + step, 1 / (1 + step))
        return moves + [_Place(self.scale * by, focus - by * (focus - self.offset)) for by in factors]

    def description(self, unit: float) -> str:
        parts = []
        if abs(math.log(self.scale)) > 0.02:
            larger = self.scale > 1
            parts.append(f"{self.scale if larger else 1 / self.scale:.3g} times {'larger' if larger else 'smaller'}")
        if float(self.offset.norm()) > 0.02 * unit:
            parts.append("moved by (" + ", ".join(f"{value:.3g}" for value in self.offset.tolist()) + ")")
        return f"the file should be {' and '.join(parts) or 'moved slightly'}: export it in the cameras' frame"


def _climb(
    stage: _Stage, viewmats: Tensor, place: _Place, focus: Tensor, unit: float, steps: tuple[float, float]
) -> tuple[float, _Place]:
    """Pattern search for the nearest maximum; ``steps`` are the first and the last step, shares of ``unit``."""
    step, smallest = steps
    best, trials = stage.score(place.seen_from(viewmats)), 0
    while step >= smallest and trials < MOST_TRIALS:
        for neighbour in place.neighbours(step, focus, unit):
            trials += 1
            score = stage.score(neighbour.seen_from(viewmats))
            if score > best:
                best, place = score, neighbour
                break
        else:
            step /= 2
    return best, place


def _shrunk(view: View, width: int) -> View:
    """The photograph and its camera at a smaller width, by area averages."""
    camera = view.camera
    if camera.width <= width:
        return view
    height = max(1, round(camera.height * width / camera.width))
    image = F.adaptive_avg_pool2d(view.image.permute(2, 0, 1).float(), (height, width)).permute(1, 2, 0)
    K = camera.K * camera.K.new_tensor([[width / camera.width], [height / camera.height], [1.0]])
    return View(replace(camera, K=K, width=width, height=height), image.round().to(torch.uint8))


def _moved(views: Sequence[View], viewmats: Tensor) -> list[View]:
    return [
        View(replace(view.camera, viewmat=viewmat.to(view.camera.viewmat)), view.image)
        for view, viewmat in zip(views, viewmats, strict=True)
    ]
