"""The reach of far Gaussians relative to ``near_distance``, chosen after training, by pictures at
equal counts.

Where near Gaussians are dense, as in an aerial scene, far ones of a shorter reach leave more of any
count to near ones, and pictures are better; where they are few, a longer one is. Before training
nothing tells which: merged Gaussians are no measure of trained ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter.cameras import View, spread
from clod_adapter.equation.attenuation import dial, kept_between, smallest_dial
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import decibels, mean_squared_error
from clod_adapter.progress import Listener, Phase, Stopped, tell
from clod_adapter.render import render
from clod_adapter.training.schedule import FAR

BUDGETS = (0.4, 0.18, 0.08, 0.04)  # shares of the near Gaussians' number, as viewers have them
MEASURED_VIEWS = 24  # few are all easy, or all hard: at 8 % views differ by 10 dB
STEP = 1.15  # factor between the reaches that are tried
MOST_STEPS = 8
FARTHEST = 1e3  # dial value at which the search for one ends
EXACT = 100.0  # dB, above which pictures are equal
LOSS = 0.1  # dB that one budget may lose for the others
PRECISION = 1e-3  # of the dial value that meets a budget


@torch.no_grad()
def fit_far_reach(
    gaussians: Gaussians, views: Sequence[View], progress: Listener | None = None
) -> Gaussians:
    """The Gaussians with the reach of far ones whose pictures differ least from those of the views.

    Divides it by STEP, or multiplies, as long as that improves the mean of the PSNR over BUDGETS,
    at equal counts, and no budget has lost more than LOSS. Budgets beyond the dial values that were
    counted in training do not matter.
    Where ``progress`` returns False, the best one so far is the result.
    """
    assert gaussians.attenuation is not None
    views = spread(views, MEASURED_VIEWS)
    images = [view.image for view in views]
    distances = [
        normalized_distances(gaussians.means, view.camera, gaussians.attenuation) for view in views
    ]
    farthest = FAR.counted * gaussians.attenuation.max_sv
    fewest = fmean(int(dial(gaussians, d, farthest).keep.sum()) for d in distances)
    counts = [budget * gaussians.whole for budget in BUDGETS]
    counts = [count for count in counts if count >= fewest]
    tried = 0

    def quality(candidate: Gaussians) -> list[float]:
        nonlocal tried
        tell(progress, Phase.FAR_REACH, tried, 2 * MOST_STEPS)
        tried += 1
        errors = torch.zeros(len(views), len(counts), dtype=torch.float64)
        for i, (view, image, d) in enumerate(zip(views, images, distances, strict=True)):
            kept = kept_between(candidate, d)
            for k, count in enumerate(counts):
                s = _dial_for(kept, count)
                rendered = render(candidate, view.camera, virtual_scale=s).image
                errors[i, k] = mean_squared_error(rendered, image)
        return [min(decibels(error), EXACT) for error in errors.mean(0).tolist()]

    if not counts:
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


def _dial_for(kept: tuple[Tensor, Tensor], count: float) -> float:
    """The smallest dial value from 1 on that keeps at most this many; ``kept`` of
    ``kept_between``.
    """
    begin, end = kept

    def fits(s: float) -> bool:
        return int(((begin < s) & (s < end)).sum()) <= count

    return 1.0 if fits(1.0) else smallest_dial(fits, 1.0, FARTHEST, PRECISION)
