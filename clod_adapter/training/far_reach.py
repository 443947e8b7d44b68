"""The reach of far Gaussians relative to ``near_distance``, chosen after training, by pictures at
equal counts.

Where near Gaussians are dense, as in an aerial scene, far ones of a shorter reach leave more of any
count to near ones, and pictures are better; where they are few, a longer one is. Before training
nothing tells which: merged Gaussians are no measure of trained ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter.cameras import View, spread
from clod_adapter.equation.attenuation import kept_between
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import decibels
from clod_adapter.progress import Listener, Phase, Stopped, tell
from clod_adapter.render import render

BUDGETS = (0.4, 0.18, 0.08, 0.04)  # shares of the near Gaussians' number, as viewers have them
MEASURED_VIEWS = 6
STEP = 1.15  # factor between the reaches that are tried
MOST_STEPS = 8
FARTHEST = 1e3  # end of the search for a dial value
EXACT = 100.0  # dB, above which pictures are equal
LOSS = 0.1  # dB that one budget may lose for the others
PRECISION = 1e-3  # of the dial value that meets a budget


@torch.no_grad()
def fit_far_reach(
    gaussians: Gaussians, views: Sequence[View], progress: Listener | None = None
) -> Gaussians:
    """The Gaussians with the reach of far ones whose pictures differ least from those of the views.

    Divides it by STEP, or multiplies, as long as that improves the mean of the PSNR over BUDGETS,
    at equal counts, and no budget has lost more than LOSS. Budgets beyond ``max_sv`` do not count.
    Where ``progress`` returns False, the best one so far is the result.
    """
    assert gaussians.attenuation is not None
    views = spread(views, MEASURED_VIEWS)
    images = [view.image / 255 for view in views]
    distances = [
        normalized_distances(gaussians.means, view.camera, gaussians.attenuation).double()
        for view in views
    ]
    reached = [_share(gaussians, d, gaussians.attenuation.max_sv) for d in distances]
    budgets = [budget for budget in BUDGETS if budget >= fmean(reached)]
    tried = 0

    def quality(candidate: Gaussians) -> list[float]:
        nonlocal tried
        tell(progress, Phase.FAR_REACH, tried, 2 * MOST_STEPS)
        tried += 1
        found = list[float]()
        for budget in budgets:
            errors = list[float]()
            for view, image, d in zip(views, images, distances, strict=True):
                s = _dial_for(candidate, d, budget)
                pixels = render(candidate, view.camera, virtual_scale=s).image.clamp(0, 1)
                errors.append(float((pixels - image).square().mean()))
            found.append(min(decibels(fmean(errors)), EXACT))
        return found

    if not budgets:
        return gaussians
    try:
        best = highest = quality(gaussians)
        for factor in (1 / STEP, STEP):
            start = gaussians
            for _ in range(MOST_STEPS):
                candidate = _with_reach(gaussians, factor)
                found = quality(candidate)
                lost = max(high - psnr for high, psnr in zip(highest, found, strict=True))
                if fmean(found) <= fmean(best) or lost > LOSS:
                    break
                gaussians, best = candidate, found
                highest = [max(pair) for pair in zip(highest, found, strict=True)]
            if gaussians is not start:
                break
    except Stopped:
        pass
    return gaussians


def _with_reach(gaussians: Gaussians, factor: float) -> Gaussians:
    """Multiplies the reach of far Gaussians, and the distance from which on they grow."""
    attenuation, sigma_d, near = gaussians.attenuation, gaussians.sigma_d, gaussians.near
    assert attenuation is not None and sigma_d is not None and near is not None
    grows_from = factor * attenuation.reference_distance
    return gaussians.replace(
        sigma_d=torch.where(near, sigma_d, factor * sigma_d),
        attenuation=replace(attenuation, reference_distance=grows_from),
    )


def _share(gaussians: Gaussians, distances: Tensor, virtual_scale: float) -> float:
    """What is kept as a share of the near Gaussians' number."""
    begin, end = kept_between(gaussians, distances)
    return int(((begin < virtual_scale) & (virtual_scale < end)).sum()) / gaussians.whole


def _dial_for(gaussians: Gaussians, distances: Tensor, budget: float) -> float:
    """The smallest dial value from 1 on that keeps at most this share."""
    begin, end = kept_between(gaussians, distances)
    count = budget * gaussians.whole

    def fits(s: float) -> bool:
        return int(((begin < s) & (s < end)).sum()) <= count

    low = high = 1.0
    while not fits(high) and high < FARTHEST:
        low, high = high, 2 * high
    while high / low > 1 + PRECISION:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high
