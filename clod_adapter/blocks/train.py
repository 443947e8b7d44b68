"""Scenes that do not fit: adapting block by block, each with the views that see it, the rest of the scene frozen.

In a first pass each block is trained against the *checkpoint* of the others: they are drawn as if they had no dial, at
every dial value, which is what their own training aims at, and the block's pictures to be are the photographs as far as
it can answer for them (``target``). So no block makes up for what another one will. (Against the others' start, at the
same dial value, each brightens what all have faded: pictures of the merged result were 8 to 11 dB worse,
docs/blocks.md.) In a second pass each goes on beside the others as the first has left them, at the dial, which brings
the blocks into accord. Within a pass the jobs are independent, and their order does not matter; what they learn
is put together by rows.

What an undivided run has for all of the scene, a block has its share of:

- The start (importance, order of leaving, sigma_d, tau) is of the whole scene.
- The unit of position steps is the extent of all cameras.
- A block takes as many steps as the undivided run takes of the views that see it, so that each Gaussian is stepped as
  often. All blocks together take more, as a view may see several.
- The count law is of all Gaussians. A block is asked for its own share of the Gaussians that the start keeps in the
  same view at the same dial value, as far as those add up to the law (``TargetShares``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.blocks.divide import Division
from clod_adapter.blocks.targets import TargetShares, beside, config_of, target
from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.scene.image_cache import ImageCache
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.training.loop import adapt
from clod_adapter.training.objective import TrainableSubset
from clod_adapter.training.state import Adapted, TrainingState


@dataclass(frozen=True)
class Learned:
    """What the training of one block gives.

    Attributes:
        rows: ``[n]`` int64, which Gaussians of the scene.
        values: their attributes that were trained, and ``sigma_d``, by name.
        steps, seconds: of the training.
    """

    rows: Tensor
    values: dict[str, Tensor]
    steps: int
    seconds: float


def adapt_block(
    division: Division,
    views: Sequence[View],
    config: AdaptConfig,
    block: int,
    *,
    after: Gaussians | None = None,
    progress: Listener | None = None,
    resume: TrainingState | None = None,
    cache: ImageCache | None = None,
) -> tuple[Learned, Adapted]:
    """One pass of training one block; the same arguments give the same bits wherever it is done.

    Args:
        views: all those that ``divide`` was given.
        config: of the whole scene; ``config_of`` is what the block has of it.
        block: from 0.
        after: of the second pass: all blocks' first, put together by ``merge``.
        resume: as ``train.adapt`` takes it, from an earlier call for the same block and pass.
        cache: keeps pictures that would else all stay in memory.

    Returns:
        What it learned, and the outcome of ``train.adapt``, whose first Gaussians are those of the block. One that
        no view sees has nothing to learn, and stays.
    """
    scene = after or division.begun
    rows, own = division.rows(block), [views[k] for k in division.views(block)]
    if not own:
        unseen = scene.select(rows)
        return _learned(division, rows, Adapted(unseen, 0, 0.0, 0.0, interrupted=False))
    gaussians = scene.select(torch.cat([rows, beside(division, block, own, after, progress)]))
    if after is None:
        own = _aimed(gaussians, len(rows), own, cache, progress)
    quotas = TargetShares(division, block, own, config, first=after is None, progress=progress)
    part = TrainableSubset(len(rows), division.extent, quotas, rest_in_full=after is None)
    settings = config_of(division, block, config, first=after is None)
    adapted = adapt(gaussians, Scene(tuple(own), ()), settings, progress, resume, subset=part)
    return _learned(division, rows, adapted)


def _learned(division: Division, rows: Tensor, adapted: Adapted) -> tuple[Learned, Adapted]:
    values = {name: value[: len(rows)] for name, value in adapted.gaussians.tensors().items()}
    changed = {
        name: value.clone() for name, value in values.items()
        if name == "sigma_d" or not torch.equal(value, getattr(division.begun, name)[rows])
    }  # fmt: skip
    return Learned(rows, changed, adapted.steps, adapted.seconds), adapted


def _aimed(
    gaussians: Gaussians, own: int, views: Sequence[View], cache: ImageCache | None,
    progress: Listener | None,
) -> list[View]:  # fmt: skip
    """The views with their ``target`` in place of the photograph."""
    found = []
    for view in views:
        aimed = View(view.camera, target(gaussians, own, view))
        found.append(cache.store(aimed, partial(target, gaussians, own, view)) if cache else aimed)
        tell(progress, Phase.TARGET_IMAGES, len(found), len(views))
    return found


def merge(division: Division, learned: Sequence[Learned]) -> Gaussians:
    """The scene with what its blocks have learned.

    Raises:
        ClodError: a Gaussian is in none of them, or in two.
    """
    times = torch.zeros_like(division.block, dtype=torch.int32)
    for part in learned:
        times[part.rows] += 1
    if not bool((times == 1).all()):
        raise ClodError(f"{int((times != 1).sum())} Gaussians are in no block or in two; give each block once")
    merged = {}
    for name in (*ATTRIBUTES, "sigma_d"):
        if any(name in part.values for part in learned):
            merged[name] = getattr(division.begun, name).clone()
            for part in learned:
                if name in part.values:
                    merged[name][part.rows] = part.values[name]
    return division.begun.replace(**merged)
