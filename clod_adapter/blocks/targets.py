"""What is asked of a block, and beside what: pictures to be, how many to keep, steps, and the Gaussians around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from clod_adapter.attenuation import attenuate, normalized_distances
from clod_adapter.blocks.divide import DIALS, Division, coverage, dial_grid, kept_counts
from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.initialization.importance import spread
from clod_adapter.losses import unit
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import splat
from clod_adapter.training.target_count import TargetShare, target_curve

LEFT_OUT = 1e-3  # of a picture, the share that those Gaussians may show that are left out of it
CONTEXT_VIEWS = 32  # that are looked at for what a block is drawn with, at most
BARE = 0.01  # of a pixel: where Gaussians show less, blocks answer for it by their size too
SECOND = 0.25  # of the steps, those of the second pass
LEAST_SEEN = 0.02  # of a picture: a block that shows less tells too little of the loss of the whole


def beside(
    division: Division,
    block: int,
    views: Sequence[View],
    after: Gaussians | None = None,
    progress: Listener | None = None,
) -> Tensor:
    """``[m]`` int64, ascending: the other Gaussians, but for those that show too little in any of the views.

    In a picture they show at most LEFT_OUT of it together, at s = 1 and at the largest dial value; of many views
    CONTEXT_VIEWS are looked at, evenly spread.

    Args:
        after: of the second pass, what the first has made of all; they are drawn as that pass draws them.
    """
    own = division.block == block
    scene = after or division.begun
    assert scene.sigma_d is not None and scene.attenuation is not None
    drawn, views = torch.zeros_like(own), spread(views, CONTEXT_VIEWS)
    for k, view in enumerate(views):
        distances = normalized_distances(scene.means, view.camera, scene.attenuation)
        for s in (1.0, scene.attenuation.max_sv):
            dialled = attenuate(scene.opacity_logits, scene.sigma_d, distances, s, scene.attenuation).drawn
            opacities = dialled if after else torch.where(own, dialled, scene.opacities)
            shown = coverage(scene, opacities, view.camera)
            drawn |= shown > _least_shown(shown)
        tell(progress, Phase.CONTEXT, k + 1, len(views))
    return (drawn & ~own).nonzero()[:, 0]


def _least_shown(shown: Tensor) -> Tensor:
    """0-d, the coverage up to which all Gaussians together show at most LEFT_OUT of the picture."""
    ordered = shown[shown > 0].sort().values
    few = int((ordered.double().cumsum(0) <= LEFT_OUT * ordered.double().sum()).sum())
    return ordered[few - 1] if few else shown.new_zeros(())


class TargetShares:
    """What the count law asks of one block: ``objective.TrainableSubset.quota``.

    Undivided, the law presses with ``loss (eta / law - 1) / (law N)`` on each of all N Gaussians. Here ``eta / law`` is
    taken to be what the block keeps by what it should: ``law N`` times its part of those that the start keeps in this
    view at this s. So at the start each block is pressed as the whole is, and an allocation that it has found stays.
    The loss is that of the whole picture: in the first pass what the block answers for by its part of the picture.
    Views that do not show the block would press on it too: each of its own stands for some of them.
    """

    def __init__(
        self,
        division: Division,
        block: int,
        views: Sequence[View],
        config: AdaptConfig,
        *,
        first: bool,
        progress: Listener | None = None,
    ) -> None:
        self.views, self.config, self.all = tuple(views), config, len(division.begun)
        rows, numbers, dials = division.rows(block), division.views(block), dial_grid(config)
        own = division.begun.select(rows)
        self.count, each = len(rows), len(division.seen) / len(numbers)
        self._of = {}
        for view, k in zip(self.views, numbers, strict=True):
            parts = np.array(kept_counts(own, view, dials)) / division.kept[k].clamp(min=1).numpy()
            stands_for = each / max(float(division.seen[k, block]), LEAST_SEEN) if first else each
            self._of[id(view)] = parts, stands_for
            tell(progress, Phase.TARGET_COUNTS, len(self._of), len(numbers))

    def __call__(self, view: View, virtual_scale: float, loss: float) -> TargetShare:
        config, (parts, stands_for) = self.config, self._of[id(view)]
        at = math.log(virtual_scale) / math.log(config.max_sv) * (DIALS - 1)
        part = float(np.interp(at, np.arange(DIALS), parts))
        law = target_curve(virtual_scale, config.start_share, config.exponent)
        wanted = max(law * self.all * part, 1.0)
        return TargetShare(wanted / self.count, stands_for * self.count / (law * self.all))


@torch.no_grad()
def target(gaussians: Gaussians, own: int, view: View) -> Tensor:
    """``[H, W, 3]`` uint8: the checkpoint's picture, with the block's part of what is between it and the photograph.

    ``p + w (q - p)`` of picture p and photograph q, w the part of a pixel that the first ``own`` Gaussians show. Over
    all blocks the parts add up to 1, and so what they are asked to change to what there is to change: none makes up for
    the same error as another.
    """
    plain = gaussians.replace(sigma_d=None, attenuation=None)
    image, alpha = splat(plain, gaussians.opacities, view.camera)
    marked = torch.full_like(gaussians.sh0, -0.5 / SH_C0)
    marked[:own] = 0.5 / SH_C0
    mine, _ = splat(plain.replace(sh0=marked, shN=gaussians.shN[:, :0]), gaussians.opacities, view.camera)
    part = ((mine[..., :1] + BARE * own / len(gaussians)) / (alpha[..., None] + BARE)).clamp(0, 1)
    aimed = ((image + part * (unit(view.image, image) - image)).clamp(0, 1) * 255).round().to(torch.uint8)
    return aimed.cpu()  # where photographs are: a device would fill up with them


def config_of(division: Division, block: int, config: AdaptConfig, *, first: bool) -> AdaptConfig:
    """The settings of one block in one pass: its steps, how long they are, its share of a time budget, its own seed."""
    steps = division.steps(block, config)
    every = sum(division.steps(other, config) for other in range(division.count))
    light = round(SECOND * steps) if division.passes > 1 else 0
    own = steps - light if first else light
    seed = (config.seed + 1 + block + (0 if first else division.count)) % 2**63
    budget = config.time_budget and config.time_budget * own / max(every, 1) or None
    # Step sizes fall as in an undivided run: from 1 to middle to lr_final.
    middle = config.lr_final ** (1 - light / max(steps, 1))
    last = replace(
        config.lighter(middle), lr_sigma=middle * config.lr_sigma, lr_final=config.lr_final / middle,
        average=min(config.average * steps / max(light, 1), 1.0),
    )  # fmt: skip
    return replace(replace(config, lr_final=middle) if first else last, iters=own, time_budget=budget, seed=seed)
