"""The reach of far Gaussians relative to ``near_distance``, chosen after training, by pictures at
equal counts.

Where near Gaussians are dense, as in an aerial scene, far ones of a shorter reach leave more of any
count to near ones, and pictures are better; where they are few, a longer one is. Before training
nothing tells which: merged Gaussians are no measure of trained ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter.cameras import View
from clod_adapter.equation.attenuation import dial, kept_between, smallest_dial
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import mean_squared_error
from clod_adapter.progress import Listener, Phase, Stopped, tell
from clod_adapter.render import render
from clod_adapter.training.schedule import FAR

BUDGETS = (0.4, 0.18, 0.08, 0.04)  # shares of the near Gaussians' number, as viewers have them
MEASURED_VIEWS = 24  # few are all easy, or all hard; the first ones see what photographs would
STEP = 1.15  # factor between the reaches that are tried
MOST_STEPS = 8
FARTHEST = 1e3  # dial value at which the search for one ends
PRECISION = 1e-3  # of the dial value that meets a budget


@torch.no_grad()
def fit_far_reach(
    gaussians: Gaussians,
    views: Sequence[View],
    progress: Listener | None = None,
) -> Gaussians:
    """The Gaussians with the reach of far ones whose pictures differ least from those of the views.

    Divides it by STEP, or multiplies, as long as the RMS error of a picture becomes smaller in the
    mean over views and BUDGETS, at equal counts. Of decibels those of nearly equal pictures would
    decide, and of squared errors those of a few views. Budgets beyond the dial values that were
    counted in training do not matter.
    Where ``progress`` returns False, the best one so far is the result.
    """
    config = gaussians.attenuation
    assert config is not None
    farthest = FAR.counted * config.max_sv
    measured = []
    kept = []
    for view in views[:MEASURED_VIEWS]:
        distances = normalized_distances(gaussians.means, view.camera, config)
        measured.append((view.camera, view.image, distances))
        kept.append(int(dial(gaussians, distances, farthest).keep.sum()))
    counts = [budget * gaussians.whole for budget in BUDGETS]
    counts = [count for count in counts if count >= fmean(kept)]
    if not counts:
        return gaussians
    tried = 0

    def error(candidate: Gaussians) -> float:
        nonlocal tried
        tell(progress, Phase.FAR_REACH, tried, 2 * MOST_STEPS)
        tried += 1
        errors = []
        for camera, image, distances in measured:
            between = kept_between(candidate, distances)
            for count in counts:
                rendered = render(candidate, camera, virtual_scale=_dial_for(between, count))
                errors.append(math.sqrt(mean_squared_error(rendered.image, image)))
        return fmean(errors)

    with suppress(Stopped):
        smallest = error(gaussians)
        for factor in (1 / STEP, STEP):
            start = gaussians
            for _ in range(MOST_STEPS):
                candidate = _with_reach(gaussians, factor)
                found = error(candidate)
                if found >= smallest:
                    break
                gaussians = candidate
                smallest = found
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
