"""Do a checkpoint and posed photographs share a frame? What its renders say, before anything is trained on them.

A picture's trivial predictor is one colour, the photograph's own mean; the error it leaves is the photograph's
variance. With ``I_v`` the render at dial 1 over black, clamped to [0, 1], and ``P_v`` the photograph of view v, means
over pixels and channels,

    error_v    = mean (I_v - P_v)^2
    constant_v = mean (P_v - mean P_v)^2        the mean of each channel

a checkpoint whose pooled error is the larger one knows less of the pictures than their mean colours do: nearly always
it stands elsewhere, in other axes or at another scale. What else can look like that is told apart: views that the
checkpoint does not reach while it explains the others (the count of views it explains), another exposure (the
correlation, which gain and offset do not change) and another background (the same over white).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from clod_adapter.attenuation import in_frustum
from clod_adapter.cameras import View
from clod_adapter.config import require
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import spread
from clod_adapter.losses import unit
from clod_adapter.render import render

MOST_VIEWS = 8
# Photographs that vary by less, root mean square, are one colour but for noise and rounding.
FLAT = 2 / 255
# Of a fitting file nine tenths and more are in sight of eight photographs, of a large one given a part of its cameras
# much less; so this decides only where all photographs are flat.
FEWEST_IN_VIEW = 0.01
# Of files that are far from their place at most 0.39, of those that a pixel or two are missing 0.43 and more: a guess
# tells these. Of fitting ones 0.91 and more, with half of their Gaussians left out 0.67 (benchmarks/alignment.py).
CORRELATED = 0.5
CLEAR = 3.0  # dB by which another explanation must be better than the present one
DOUBTFUL = 6.0  # dB over the mean colours below which another frame may be the reason; fitting files had 8 to 18


@dataclass(frozen=True)
class Alignment:
    """What renders and photographs have in common; PSNRs in dB, pooled (of the mean squared error over the views).

    Attributes:
        views: compared; those whose photograph is one colour are not.
        in_view: share of the Gaussians whose centre projects into any of the views, in [0, 1].
        psnr: of the renders; NaN, like the next four, where no view was compared.
        mean_colour_psnr: of each photograph's own mean colour.
        white_psnr: of the renders over white.
        correlation: of renders and photographs, each less its own mean colour, in [-1, 1].
        explained: share of the views that the render explains better than the mean colour, in [0, 1].
    """

    views: int
    in_view: float
    psnr: float
    mean_colour_psnr: float
    white_psnr: float
    correlation: float
    explained: float

    @property
    def fits(self) -> bool:
        """Whether something speaks for a common frame, and nothing for a white background.

        Of flat photographs, whether FEWEST_IN_VIEW are in sight; of others a black picture is never better than the
        mean colour, so that a file with nothing in sight does not fit.
        """
        if not self.views:
            return self.in_view >= FEWEST_IN_VIEW
        shown = self.margin > 0 or self.explained >= 0.5 or self.correlation >= CORRELATED
        return shown and not self.on_white

    @property
    def margin(self) -> float:
        """dB by which the renders are closer to the photographs than their mean colours; NaN for flat ones."""
        return self.psnr - self.mean_colour_psnr

    @property
    def on_white(self) -> bool:
        """Whether the renders are worse than the mean colours over black, and better over white."""
        return self.margin < 0 < self.white_psnr - self.mean_colour_psnr and self.white_psnr > self.psnr + CLEAR

    def as_dict(self) -> dict[str, float]:
        """By name."""
        return asdict(self)


@torch.no_grad()
def check_alignment(gaussians: Gaussians, views: Sequence[View]) -> Alignment:
    """Renders at most MOST_VIEWS of the views, evenly spread, at dial 1, and compares them with the photographs.

    Raises:
        ClodError: there are no views.
    """
    require(len(views) > 0, "number of views", len(views), "at least 1")
    views = spread(views, MOST_VIEWS)
    seen = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for view in views:
        seen |= in_frustum(gaussians.means, view.camera)
    in_view = float(seen.float().mean()) if len(seen) else 0.0
    compared = [row for view in views if (row := compare(gaussians, view)) is not None]
    if not compared:
        return Alignment(0, in_view, *[math.nan] * 5)
    table = torch.stack(compared)
    error, over_white, constant, rendered, shared = table.mean(0).tolist()
    return Alignment(
        views=len(compared), in_view=in_view, psnr=_decibels(error), mean_colour_psnr=_decibels(constant),
        white_psnr=_decibels(over_white), correlation=shared / math.sqrt(constant * rendered) if rendered > 0 else 0.0,
        explained=float((table[:, 0] < table[:, 2]).float().mean()),
    )  # fmt: skip


def compare(gaussians: Gaussians, view: View) -> Tensor | None:
    """``[5]``, means over pixels and channels; None where the photograph is one colour.

    The squared error of the render over black, over white, and of the photograph's mean colour (its variance); the
    render's variance, and the covariance of the two.
    """
    photograph = unit(view.image, gaussians.means)
    about = photograph - photograph.mean((0, 1))
    if float(about.square().mean().sqrt()) < FLAT:
        return None
    rendering = render(gaussians, view.camera)
    black = rendering.image.clamp(0, 1)
    white = (rendering.image + (1 - rendering.alpha)[..., None]).clamp(0, 1)
    centred = black - black.mean((0, 1))
    rows = [(black - photograph).square(), (white - photograph).square(), about.square(), centred.square()]
    return torch.stack([row.mean() for row in (*rows, centred * about)])


def _decibels(error: float) -> float:
    """PSNR of a mean squared error: infinite for 0, NaN for NaN."""
    return math.inf if error == 0 else -10 * math.log10(error)
