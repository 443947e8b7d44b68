"""The reach of far Gaussians relative to ``near_distance``, chosen after training, by pictures at
equal counts.

Where near Gaussians are dense, as in an aerial scene, far ones of a shorter reach leave more of any
count to near ones, and pictures are better; where they are few, a longer one is. Before training
nothing tells which: merged Gaussians are no measure of trained ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter.cameras import View, spread
from clod_adapter.equation.attenuation import dial, kept_between, smallest_dial
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import mean_squared_error
from clod_adapter.progress import Listener, Phase, Stopped, tell
from clod_adapter.render import render
from clod_adapter.training.schedule import FAR

BUDGETS = (0.4, 0.18, 0.08, 0.04)  # shares of the near Gaussians' number, as viewers have them
MEASURED_VIEWS = 24  # few are all easy, or all hard: at 8 % views differ by 10 dB
STEP = 1.15  # factor between the reaches that are tried
MOST_STEPS = 8
FARTHEST = 1e3  # dial value at which the search for one ends
EXACT = 1e-10  # squared error below which pictures are equal
LOSS = 0.1  # dB that one budget may lose for the others
PRECISION = 1e-3  # of the dial value that meets a budget


@torch.no_grad()
def fit_far_reach(
    gaussians: Gaussians,
    views: Sequence[View],
    progress: Listener | None = None,
) -> Gaussians:
    """The Gaussians with the reach of far ones whose pictures differ least from those of the views.

    Divides it by STEP, or multiplies, as long as that improves the mean of the PSNR over BUDGETS,
    at equal counts, and no budget has lost more than LOSS. Budgets beyond the dial values that were
    counted in training do not matter.
    Where ``progress`` returns False, the best one so far is the result.
    """
    config = gaussians.attenuation
    assert config is not None
    farthest = FAR.counted * config.max_sv
    measured = []
    kept = []
    for view in spread(views, MEASURED_VIEWS):
        distances = normalized_distances(gaussians.means, view.camera, config)
        measured.append((view.camera, view.image, distances))
        kept.append(int(dial(gaussians, distances, farthest).keep.sum()))
    counts = [budget * gaussians.whole for budget in BUDGETS]
    counts = [count for count in counts if count >= fmean(kept)]
    if not counts:
        return gaussians
    tried = 0

    def quality(candidate: Gaussians) -> Tensor:
        """PSNR at each of the counts, dB."""
        nonlocal tried
        tell(progress, Phase.FAR_REACH, tried, 2 * MOST_STEPS)
        tried += 1
        errors = torch.zeros(len(measured), len(counts), dtype=torch.float64)
        for i, (camera, image, distances) in enumerate(measured):
            between = kept_between(candidate, distances)
            for k, count in enumerate(counts):
                rendered = render(candidate, camera, virtual_scale=_dial_for(between, count))
                errors[i, k] = mean_squared_error(rendered.image, image)
        return -10 * (errors.mean(0) + EXACT).log10()

    with suppress(Stopped):
        best = highest = quality(gaussians)
        for factor in (1 / STEP, STEP):
            start = gaussians
            for _ in range(MOST_STEPS):
                candidate = _with_reach(gaussians, factor)
                found = quality(candidate)
                if found.mean() <= best.mean() or (highest - found).max() > LOSS:
                    break
                gaussians = candidate
                best = found
                highest = highest.maximum(found)
            if gaussians is not start:
                break
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
