"""Checks before training that a checkpoint and the posed photographs share a world frame and a
screen-space filter.

A checkpoint whose renders at s = 1 have a larger error than the photographs' mean colours nearly
always has another position, other axes or another scale. Three other causes are told apart: views
outside the checkpoint's coverage (by the share of explained views), another exposure (by the
correlation) and another background (by a render over white).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from clod_adapter.cameras import View, spread
from clod_adapter.config import FILTERS
from clod_adapter.equation.distances import in_frustum
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import decibels, unit
from clod_adapter.render import render

MOST_VIEWS = 8
# Root mean square deviation, below which a photograph counts as one colour with noise.
FLAT = 2 / 255
# Decides only if all photographs are flat. Eight photographs see nine tenths of a matching file,
# but much less of a large one of which only some cameras were given.
FEWEST_IN_VIEW = 0.01
# Misplaced files measured at most 0.39, those off by a pixel or two at least 0.43 (the search finds
# these), matching ones at least 0.91, or 0.67 with half of the Gaussians removed.
CORRELATED = 0.5
CLEAR = 3.0  # dB by which another explanation must be better
# dB above the mean colours, below which the frame may be wrong; matching files had 8 to 18
DOUBTFUL = 6.0
# A wrong filter measured at least 0.48 dB worse than that of training.
CLEAR_FILTER = 0.2  # dB, mean over the views
AGREEING = 0.75  # share of the views in which the chosen filter must be better


@dataclass(frozen=True)
class Alignment:
    """Agreement of renders and photographs; PSNRs are of the mean squared error over the views, NaN
    without any.
    """

    views: int  # number of views compared; photographs of one colour are skipped
    in_view: float  # share of the Gaussians whose centre projects into any of the views
    psnr: float  # of the renders
    mean_colour_psnr: float  # of each photograph's mean colour
    white_psnr: float  # of the renders over white
    correlation: float  # of renders and photographs, each minus its mean colour
    explained: float  # share of the views whose render has a smaller error than the mean colour

    @property
    def fits(self) -> bool:
        """Whether any measure supports a common frame and none a white background.

        With flat photographs only: whether FEWEST_IN_VIEW of the Gaussians are in view.
        """
        if not self.views:
            return self.in_view >= FEWEST_IN_VIEW
        matches = self.margin > 0 or self.explained >= 0.5 or self.correlation >= CORRELATED
        return matches and not self.on_white

    @property
    def margin(self) -> float:
        """dB of the renders above the mean colours; NaN if no view was compared."""
        return self.psnr - self.mean_colour_psnr

    @property
    def doubtful(self) -> bool:
        """Whether another frame may explain the photographs better."""
        return not self.on_white and (not self.fits or self.margin < DOUBTFUL)

    @property
    def on_white(self) -> bool:
        """Whether the renders are worse than the mean colours over black, but better over white."""
        return (
            self.margin < 0 < self.white_psnr - self.mean_colour_psnr
            and self.white_psnr > self.psnr + CLEAR
        )


@torch.no_grad()
def check_alignment(gaussians: Gaussians, views: Sequence[View]) -> Alignment:
    """Renders at most MOST_VIEWS of the views, evenly spread, at s = 1, and compares them with the
    photographs.
    """
    views = spread(views, MOST_VIEWS)
    in_frustums = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for view in views:
        in_frustums |= in_frustum(gaussians.means, view.camera)
    in_view = float(in_frustums.float().mean()) if len(in_frustums) else 0.0
    table = compare_renders(gaussians, views)
    if not len(table):
        return Alignment(0, in_view, *[math.nan] * 5)
    error, over_white, constant = table.mean(0).tolist()[:3]
    better = table[:, 0] < table[:, 2]
    return Alignment(
        views=len(table),
        in_view=in_view,
        psnr=decibels(error),
        mean_colour_psnr=decibels(constant),
        white_psnr=decibels(over_white),
        correlation=correlation(table),
        explained=float(better.float().mean()),
    )


def compare_renders(gaussians: Gaussians, views: Sequence[View]) -> Tensor:
    """``[n, 5]`` means over the pixels and channels of each photograph that is not of one colour.

    Squared error of the render over black, over white, and of the photograph's mean colour;
    variance of the render; covariance of render and photograph.
    """
    rows = []
    for view in views:
        photograph = unit(view.image, gaussians.means)
        deviation = photograph - photograph.mean((0, 1))
        if float(deviation.square().mean().sqrt()) < FLAT:
            continue
        rendering = render(gaussians, view.camera)
        black = rendering.image.clamp(0, 1)
        background = (1 - rendering.alpha)[..., None]
        white = (rendering.image + background).clamp(0, 1)
        centred = black - black.mean((0, 1))
        columns = (
            (black - photograph).square(),
            (white - photograph).square(),
            deviation.square(),
            centred.square(),
            centred * deviation,
        )
        rows.append(torch.stack([values.mean() for values in columns]))
    return torch.stack(rows) if rows else gaussians.means.new_empty(0, 5)


def correlation(table: Tensor) -> float:
    """The correlation of renders and photographs, by ``compare_renders``; 0 without any."""
    constant, rendered, shared = table.mean(0).tolist()[2:]
    return shared / math.sqrt(constant * rendered) if rendered > 0 else 0.0


@torch.no_grad()
def compare_filters(
    gaussians: Gaussians,
    views: Sequence[View],
    expected: str = "off",
) -> tuple[str, dict[str, float]]:
    """The name in FILTERS of the filter that fits the photographs, and the mean PSNR with each.

    Most files do not name theirs. With another filter than that of training, Gaussians of about a
    pixel render too opaque or too faint. Another than ``expected`` is chosen if its mean PSNR over
    MOST_VIEWS of the views is CLEAR_FILTER dB higher, its PSNR is higher in AGREEING of them and
    its pooled error is DOUBTFUL dB below that of the photographs' mean colours (in a wrong frame,
    fainter is closer).
    """
    views = spread(views, MOST_VIEWS)
    tables = []
    for screen_filter in FILTERS.values():
        tables.append(compare_renders(gaussians.replace(screen_filter=screen_filter), views))
    error = torch.stack(tables)[:, :, 0]  # by filter and view
    constant = float(tables[0][:, 2].mean())
    psnr = -10 * error.clamp(min=1e-10).log10()
    names = list(FILTERS)
    gained = psnr - psnr[names.index(expected)]
    means = psnr.mean(1)
    clear = gained.mean(1) > CLEAR_FILTER
    clear &= (gained > 0).float().mean(1) >= AGREEING
    clear &= error.mean(1) < constant * 10 ** (-DOUBTFUL / 10)
    best = expected
    if bool(clear.any()):
        best = names[int(means.where(clear, -math.inf).argmax())]
    return best, dict(zip(names, means.tolist(), strict=True))
