"""Division of a scene into blocks: the Gaussians of each, the views that see it, and the shared initialization."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import coverage, reduced
from clod_adapter.progress import Listener, Phase, tell

UNSEEN = 0.005  # of a block's coverage over all views, the share that the views it is not trained on may have


@dataclass(frozen=True)
class Division:
    """A scene divided into blocks, with its initialization.

    Attributes:
        initial: the Gaussians that are trained, N, with the initial dial.
        block: ``[N]`` int16, the block of each Gaussian.
        seen: ``[V, B]`` float32, the share of each view's image that each block covers.
        total: number of Gaussians that target counts are shares of: N and those that a plan leaves out.
    """

    initial: Gaussians
    block: Tensor
    seen: Tensor
    total: int

    @property
    def count(self) -> int:
        """Number of blocks."""
        return self.seen.shape[1]

    @property
    def passes(self) -> int:
        """Number of training passes over each block; a single block needs no second one."""
        return 2 if self.count > 1 else 1

    def rows(self, block: int) -> Tensor:
        """``[n]`` int64, ascending: the rows of a block."""
        return (self.block == block).nonzero()[:, 0]

    def views(self, block: int) -> list[int]:
        """The fewest views with all but UNSEEN of a block's coverage, ascending; none for an unseen block."""
        shares, order = self.seen[:, block].double().sort(descending=True, stable=True)
        covered = shares.cumsum(0)
        if not covered[-1] > 0:
            return []
        fewest = int((covered < (1 - UNSEEN) * covered[-1]).sum()) + 1
        return sorted(order[:fewest].tolist())

    def steps(self, block: int, config: AdaptConfig) -> int:
        """Training steps of a block in both passes: as many as an undivided run takes of the views that see it."""
        return math.ceil(config.steps * len(self.views(block)) / len(self.seen))


def split(means: Tensor, count: int) -> Tensor:
    """``[N]`` int16: the block, of ``count``, of each centre; block sizes differ by at most one.

    A k-d tree: the longest side is split at the median (at the corresponding quantile where the count is odd). Sides
    are measured between the 5 % and the 95 % quantile, so that a few far Gaussians do not determine the split.

    Raises:
        ClodError: there are fewer Gaussians than blocks.
    """
    if not 1 <= count <= min(len(means), 2**15 - 1):
        raise ClodError(f"{len(means)} Gaussians cannot be split into {count} blocks; take from 1 to as many as these")
    block = np.empty(len(means), np.int16)
    points = means.detach().cpu().numpy()
    todo = [(np.arange(len(means)), 0, count)]
    while todo:
        rows, first, parts = todo.pop()
        if parts == 1:
            block[rows] = first
            continue
        some = points[rows[:: max(len(rows) // 100_000, 1)]]
        low, high = np.quantile(some, (0.05, 0.95), axis=0)
        fewer = parts // 2
        cut = first_size(len(rows), parts, fewer)
        order = np.argpartition(points[rows, int((high - low).argmax())], cut)
        todo += [(rows[order[:cut]], first, fewer), (rows[order[cut:]], first + fewer, parts - fewer)]
    return torch.from_numpy(block).to(means.device)


def first_size(total: int, parts: int, fewer: int) -> int:
    """Size of the first ``fewer`` of ``parts`` even parts of ``total``."""
    whole, rest = divmod(total, parts)
    return fewer * whole + min(fewer, rest)


def divide(
    initial: Gaussians,
    views: Sequence[View],
    config: AdaptConfig,
    count: int,
    *,
    total: int | None = None,
    progress: Listener | None = None,
) -> Division:
    """Splits a scene into ``count`` blocks.

    Args:
        initial: the whole scene, from ``importance.initialize``, or as much of it as a plan trains.
        views: ``importance.usable_views`` of the training views.
        total: ``Division.total``; by default the number of Gaussians in ``initial``.
        progress: called in ``Phase.COVERAGE`` after each view.

    Raises:
        ClodError: blocks cannot be trained with these settings, or there are fewer Gaussians than blocks.
    """
    check_divisible(config)
    assert initial.attenuation is not None
    if initial.attenuation.normalizer != "scene":
        raise ClodError(
            f"the checkpoint's dial has the normaliser {initial.attenuation.normalizer}, whose distances depend on all "
            "Gaussians in view: it cannot be trained in blocks; adapt it whole"
        )
    block, seen = split(initial.means, count), torch.empty(len(views), count, dtype=torch.float32)
    for k, view in enumerate(views):
        shown = coverage(initial, initial.opacities, reduced(view.camera)).double()
        seen[k] = (shown.new_zeros(count).index_add_(0, block.long(), shown) / shown.sum().clamp(min=1e-9)).float()
        tell(progress, Phase.COVERAGE, k + 1, len(views))
    return Division(initial, block, seen, total or len(initial))


def check_divisible(config: AdaptConfig) -> None:
    """Raises ClodError for settings that need the whole scene at once."""
    if config.form == "paper":
        raise ClodError(
            "the paper's form cannot be trained in blocks: its count and its distances are of all Gaussians at once; "
            "leave out --form paper, or --memory"
        )
