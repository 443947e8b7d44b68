"""Which screen-space filter was a checkpoint trained with? What its renders with each say, beside the photographs.

A checkpoint holds the opacities and scales that suit one ``ScreenFilter``, and most files do not say which. Drawn with
another one it is off: Gaussians of a pixel and less are too opaque or too faint. So the views are rendered with each
filter that is in use, and one that is clearly closer to the photographs than the usual one is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from clod_adapter.alignment.check import DOUBTFUL
from clod_adapter.cameras import View
from clod_adapter.config import FILTERS, ScreenFilter
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import spread
from clod_adapter.losses import unit
from clod_adapter.render import render

MOST_VIEWS = 8
# Of files trained with another filter the usual one is 1.7 dB worse and more, of files trained with the usual one the
# others are 0.48 dB worse and more (benchmarks/antialias.py).
CLEAR = 0.2  # dB, in the mean over the views
MOST = 0.75  # share of the views in which the other one has to be better


@dataclass(frozen=True)
class FilterComparison:
    """What renders with each filter have in common with the photographs.

    Attributes:
        psnr: dB by the filter's name in FILTERS, mean over the views.
        expected: the name of the filter that is taken where none is clearly better.
        chosen: the name of the filter to draw with.
    """

    psnr: dict[str, float]
    expected: str
    chosen: str

    @property
    def screen_filter(self) -> ScreenFilter:
        """To draw with."""
        return FILTERS[self.chosen]


@torch.no_grad()
def compare_filters(gaussians: Gaussians, views: Sequence[View], expected: str = "off") -> FilterComparison:
    """Renders at most MOST_VIEWS of the views, evenly spread, at dial 1, with each of FILTERS.

    Another filter than ``expected`` is chosen where its PSNR is CLEAR dB higher in the mean over the views, it is
    higher in MOST of them, and its pooled error is ``alignment.DOUBTFUL`` dB below that of the photographs' mean
    colours: else the checkpoint may not belong to them, and a fainter picture is the nearer one for that. Of two such
    the one with the higher mean.

    Args:
        expected: name of the filter that is taken where the photographs do not tell.
    """
    views = spread(views, MOST_VIEWS)
    errors = {name: _errors(gaussians.replace(screen_filter=each), views) for name, each in FILTERS.items()}
    psnr = {name: _decibels(table) for name, table in errors.items()}
    constant = _constant(views)
    clear = [
        name
        for name in FILTERS
        if float((psnr[name] - psnr[expected]).mean()) > CLEAR
        and float((psnr[name] > psnr[expected]).float().mean()) >= MOST
        and float(errors[name].mean()) < constant * 10 ** (-DOUBTFUL / 10)
    ]
    means = {name: float(each.mean()) for name, each in psnr.items()}
    return FilterComparison(means, expected, max(clear, key=means.__getitem__, default=expected))


def _errors(gaussians: Gaussians, views: Sequence[View]) -> Tensor:
    """``[views]`` mean squared errors of the clamped renders."""
    pictures = [render(gaussians, view.camera).image.clamp(0, 1) for view in views]
    return torch.stack(
        [(image - unit(view.image, image)).square().mean() for view, image in zip(views, pictures, strict=True)]
    )


def _constant(views: Sequence[View]) -> float:
    """The mean squared error of each photograph's own mean colour."""
    pixels = [view.image.float() / 255 for view in views]
    return math.fsum(float((image - image.mean((0, 1))).square().mean()) for image in pixels) / len(pixels)


def _decibels(errors: Tensor) -> Tensor:
    return -10 * errors.clamp(min=1e-10).log10()
