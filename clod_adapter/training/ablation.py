"""What a scene needs of a checkpoint, measured on its training views: bands, rows, and attributes that are tuned."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter.cameras import View
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, removal_error, spread
from clod_adapter.losses import psnr
from clod_adapter.rasterizers import ALPHA_MAX
from clod_adapter.render import render


@torch.no_grad()
def band_losses(base: Gaussians, views: Sequence[View], limit: float) -> Iterator[tuple[int, float]]:
    """What the highest SH bands are worth: from the highest one down, (degree, dB without it and those above).

    By how much PSNR against the photographs at full detail changes in either direction, mean over ``views``: one's
    gain makes up for no other's loss. Ends after the first that is not below ``limit``. Bands that are 0 throughout
    are not rendered for.
    """
    used = base.without_empty_bands().sh_degree
    yield from ((degree, 0.0) for degree in range(base.sh_degree, used, -1))
    pictures = [render(base.without_bands(used), view.camera).image for view in views] if used else []
    with_all = [psnr(image, view.image) for image, view in zip(pictures, views, strict=True)] if used else []
    for degree in range(used, 0, -1):
        less = base.without_bands(degree - 1)
        without = [psnr(render(less, view.camera).image, view.image) for view in views]
        change = _mean_change(with_all, without)
        yield degree, change
        if not change < limit:
            return


def seen(
    base: Gaussians, views: Sequence[View], error: Tensor, seed: int, progress: Callable[[int, int], None] | None = None
) -> Tensor:
    """``[N]`` bool, which Gaussians move any pixel of any of the views.

    A picture is linear in each opacity, so a Gaussian by whose opacity no pixel's derivative differs from 0 changes
    nothing when it goes. The backward pass of ``removal_error`` has the derivatives with random signs: that those of a
    Gaussian cancel to exactly 0 in all pixels and views of it has no weight in practice, and ``largest_change`` bounds
    what it would do. Rasterizers clamp alpha, above which it has no derivative: Gaussians that opaque count as seen.
    Views that have made ``error`` are not looked at again.

    Args:
        error: ``[N]`` the ``removal_error`` of ``spread(views, MOST_VIEWS)``, as ``importance.initialize`` takes it.
        seed: of the signs.
        progress: called with the number of other views done, and of all of them.
    """
    rendered = set(spread(range(len(views)), MOST_VIEWS))
    others = [view for k, view in enumerate(views) if k not in rendered]
    moves = (error > 0) | (removal_error(base, others, seed=seed, progress=progress) > 0)
    return moves | (base.opacities > ALPHA_MAX)


@torch.no_grad()
def largest_change(
    base: Gaussians, less: Gaussians, views: Sequence[View], progress: Callable[[int, int], None] | None = None
) -> tuple[float, float]:
    """The largest difference of a channel between pictures of the two, in [0, 1]; and dB lost, mean over views."""
    largest, lost = 0.0, []
    for done, view in enumerate(views, 1):
        with_all, without = (render(each, view.camera).image.clamp(0, 1) for each in (base, less))
        largest = max(largest, float((with_all - without).abs().max()))
        lost.append(_difference(psnr(with_all, view.image), psnr(without, view.image)))
        if progress:
            progress(done, len(views))
    return largest, fmean(lost) if lost else 0.0


@torch.no_grad()
def effect(
    name: str, before: Gaussians, after: Gaussians, views: Sequence[View], dials: Sequence[float], limit: float
) -> tuple[float, float]:
    """What the move of one attribute from ``before`` to ``after`` does: (dB, the dial value that it was found at).

    By how much PSNR against the photographs, mean over ``views``, changes where the attribute is put back and the
    others are as in ``after``, in either direction view by view: early in a training steps are long, and even what
    will be useful may do harm. At each of ``dials`` in turn, until one is at least ``limit``; else the largest.
    """
    old, new = getattr(before, name), getattr(after, name)
    most = (0.0, dials[0])
    if torch.equal(old, new):
        return most
    back = after.replace(**{name: old})
    for s in dials:
        most = max(most, (_mean_change(_errors(after, views, s), _errors(back, views, s)), s))
        if most[0] >= limit:
            break
    return most


def _errors(gaussians: Gaussians, views: Sequence[View], s: float) -> list[float]:
    return [psnr(render(gaussians, view.camera, s).image, view.image) for view in views]


def _mean_change(these: Sequence[float], those: Sequence[float]) -> float:
    return fmean(abs(_difference(a, b)) for a, b in zip(these, those, strict=True))


def _difference(this: float, that: float) -> float:
    """dB between two PSNR; 0 where both are infinite."""
    return 0.0 if this == that else this - that
