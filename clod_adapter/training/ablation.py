"""Effect on the training views of removing SH degrees or Gaussians."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter.cameras import View
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import removal_error
from clod_adapter.losses import psnr
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.rasterizers import ALPHA_MAX
from clod_adapter.render import render, splat
from clod_adapter.training.gate import decibels_below, squared_error


@torch.no_grad()
def sh_degree_losses(base: Gaussians, views: Sequence[View], limit: float) -> Iterator[tuple[int, float]]:
    """Effect of removing the highest SH degrees: (degree, dB without it and those above), from the highest down.

    The mean over ``views`` of the absolute change of PSNR against the photographs at full detail. Ends after the first
    degree that is not below ``limit``. Degrees whose coefficients are all 0 have effect 0 without rendering.
    """
    used = base.without_empty_bands().sh_degree
    yield from ((degree, 0.0) for degree in range(base.sh_degree, used, -1))
    pictures = [render(base.without_bands(used), view.camera).image for view in views] if used else []
    with_all = [psnr(image, view.image) for image, view in zip(pictures, views, strict=True)] if used else []
    for degree in range(used, 0, -1):
        less = base.without_bands(degree - 1)
        without = [psnr(render(less, view.camera).image, view.image) for view in views]
        change = fmean(abs(_difference(a, b)) for a, b in zip(with_all, without, strict=True))
        yield degree, change
        if not change < limit:
            return


def seen(base: Gaussians, others: Sequence[View], error: Tensor, seed: int, progress: Listener | None = None) -> Tensor:
    """``[N]`` bool, which Gaussians change any pixel of any of the views that ``error`` is from, and of the others.

    An image is linear in each opacity, so removing a Gaussian changes nothing if no pixel has a derivative by its
    opacity. The backward pass of ``removal_error`` sums the derivatives with random signs; that all of them cancel to
    exactly 0 is not relevant in practice, and ``largest_change`` bounds the effect. Rasterizers clamp alpha, where it
    has no derivative: Gaussians that opaque count as seen.

    Args:
        error: ``[N]`` from ``removal_error``.
        seed: of the signs.
        progress: called in ``Phase.IMPORTANCE`` after each of the other views.
    """
    moves = (error > 0) | (removal_error(base, others, seed=seed, progress=progress) > 0)
    return moves | (base.opacities > ALPHA_MAX)


@torch.no_grad()
def needed_share(base: Gaussians, views: Sequence[View], error: Tensor, limit: float) -> tuple[float, float]:
    """The smallest share of the Gaussians that loses less than ``limit`` dB, in hundredths, and that loss.

    In (0.5, 1], by bisection. The Gaussians with the largest removal error remain, unattenuated. The loss is
    ``gate.decibels_below`` the base.

    Args:
        error: ``[N]`` from ``removal_error``.
    """
    order, opacities = error.argsort(descending=True, stable=True), base.opacities
    whole = [_squared_error(base, opacities, view) for view in views]

    def loss(percent: int) -> float:
        less = opacities.clone()
        less[order[max(round(percent / 100 * len(base)), 1) :]] = 0  # neither sorted nor drawn; a copy is large
        return decibels_below([_squared_error(base, less, view) for view in views], whole)

    low, high, found = 50, 100, 0.0
    while high - low > 1:
        middle = (low + high) // 2
        lost = loss(middle)
        low, high, found = (low, middle, lost) if lost < limit else (middle, high, found)
    return high / 100, found


def _squared_error(gaussians: Gaussians, opacities: Tensor, view: View) -> float:
    return squared_error(splat(gaussians, opacities, view.camera)[0], view)


@torch.no_grad()
def largest_change(
    base: Gaussians, less: Gaussians, views: Sequence[View], progress: Listener | None = None
) -> tuple[float, float]:
    """The largest difference of a channel between renderings of the two, in [0, 1], and the mean loss of PSNR in dB."""
    largest, lost = 0.0, []
    for done, view in enumerate(views, 1):
        with_all, without = (render(each, view.camera).image.clamp(0, 1) for each in (base, less))
        largest = max(largest, float((with_all - without).abs().max()))
        lost.append(_difference(psnr(with_all, view.image), psnr(without, view.image)))
        tell(progress, Phase.TRIMMING, done, len(views))
    return largest, fmean(lost) if lost else 0.0


def _difference(this: float, that: float) -> float:
    """dB between two PSNR; 0 where both are infinite."""
    return 0.0 if this == that else this - that
