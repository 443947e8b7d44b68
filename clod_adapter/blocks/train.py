"""Adapting scenes that do not fit in memory: block by block, each with the views that see it, the rest frozen.

In the first pass each block is trained against the *checkpoint* of the others: these are drawn without a dial, which is
what their own training aims at, and the target images are the photographs as far as the block covers them
(``target_image``). (Against the others' initialization at the same dial value, each block brightens what all have
faded: images were 8 to 11 dB worse.) In the second pass the others are at the dial, as the first pass trained them.
Within a pass blocks are independent; their rows are then merged. The initialization is that of the whole scene.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from clod_adapter.blocks.divide import Division, block_config, block_target, context_rows, target_image
from clod_adapter.cameras import Scene, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError, refused_if_damaged
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.file_formats import refuse_irregular
from clod_adapter.io.scene.load import ImageCache
from clod_adapter.io.tensor_file import read_tensors, write_tensors
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.training.dial import TrainableSubset
from clod_adapter.training.loop import adapt
from clod_adapter.training.state import Adapted, TrainingState

KEY = "clod_adapter_block"  # of the JSON document that identifies the run of a block's file


@dataclass(frozen=True)
class Learned:
    """The trained rows ``[n]`` of one block, with sigma_d and what else training changed; the rest as ``Adapted``."""

    rows: Tensor
    values: dict[str, Tensor]
    steps: int
    seconds: float
    failed: str | None = None
    held: int = 0
    interrupted: bool = False


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
) -> Learned:
    """One pass of training one block; the same arguments give the same bits on every machine of a kind."""
    scene = after or division.initial
    # Context and target images are of the placed cameras, so pseudo views stay there.
    rows, own = division.rows(block), [views[k].at(views[k].camera) for k in division.views(block)]
    if not own:
        return _learned(division, rows, Adapted(scene.select(rows), 0, 0.0, 0.0, interrupted=False))
    context = context_rows(division, block, own, after, progress)
    gaussians = scene.select(torch.cat([rows, context]))
    if after is None:
        own = _with_target_images(gaussians, len(rows), own, cache, progress)
    cameras = [view.camera for view in spread(views, MOST_VIEWS)]
    target = block_target(division, block, cameras, config, first=after is None)
    settings, span = block_config(division, block, config, first=after is None)
    part = TrainableSubset(len(rows), after is None, target=target, cameras=cameras, span=span)
    return _learned(division, rows, adapt(gaussians, Scene(tuple(own), ()), settings, progress, resume, subset=part))


def _learned(division: Division, rows: Tensor, adapted: Adapted) -> Learned:
    values = {name: value[: len(rows)] for name, value in adapted.gaussians.tensors().items()}
    changed = {
        name: value.clone() for name, value in values.items()
        if name == "sigma_d" or not torch.equal(value, getattr(division.initial, name)[rows])
    }  # fmt: skip
    return Learned(rows, changed, adapted.steps, adapted.seconds, adapted.failed, adapted.held, adapted.interrupted)


def _with_target_images(
    gaussians: Gaussians, own: int, views: Sequence[View], cache: ImageCache | None,
    progress: Listener | None,
) -> list[View]:  # fmt: skip
    """The views with their ``target_image`` in place of the photograph."""
    found = []
    for view in views:
        aimed = View(view.camera, target_image(gaussians, own, view))
        found.append(cache.store(aimed, partial(target_image, gaussians, own, view)) if cache else aimed)
        tell(progress, Phase.TARGET_IMAGES, len(found), len(views))
    return found


def merge(division: Division, learned: Sequence[Learned]) -> Gaussians:
    """The scene with the trained rows of its blocks, each given once."""
    merged = {}
    for name, initial in division.initial.tensors().items():
        parts = [part for part in learned if name in part.values]
        merged[name] = initial.clone() if parts else initial
        for part in parts:
            merged[name][part.rows] = part.values[name]
    return division.initial.replace(**merged)


def save_block(path: Path, learned: Learned, belongs: dict[str, Any]) -> None:
    """Writes the trained rows of a block, and plain JSON that identifies run, block and pass."""
    about = {name: getattr(learned, name) for name in ("steps", "seconds", "failed", "held")}
    metadata = {KEY: json.dumps({"about": about, "belongs": belongs}, sort_keys=True)}
    with atomic_path(path) as temporary:
        write_tensors(temporary, learned.values, metadata)


def load_block(path: Path, belongs: dict[str, Any], division: Division, block: int) -> Learned:
    """The inverse of ``save_block``."""
    again = "remove it to have it made anew"
    refuse_irregular(path, "remove it")
    with refused_if_damaged(path, "is no block or is damaged", again):
        tensors, metadata = read_tensors(path)
        found = json.loads(metadata[KEY])
        about, theirs = found["about"], dict(found["belongs"])
        about |= {name: kind(about[name]) for name, kind in (("steps", int), ("seconds", float), ("held", int))}
        learned = Learned(division.rows(block), tensors, **about)
    different = [name for name in belongs if theirs.get(name) != belongs[name]]
    if different:
        raise ClodError(f"{path}: is of a run with another {different[0]}; remove it, or give --out another name")
    shapes = {name: (len(learned.rows), *value.shape[1:]) for name, value in division.initial.tensors().items()}
    for name in {"sigma_d": None, **tensors}:
        value = tensors.get(name)
        if value is None or value.dtype != torch.float32 or value.shape != shapes.get(name):
            raise ClodError(f"{path}: its {name} is not that of this scene; {again}")
        opaque = value == math.inf if name == "opacity_logits" else False  # files in the wild have these logits
        if not bool((value.isfinite() | opaque).all()):
            raise ClodError(f"{path}: holds a value that is not finite; {again}")
    return replace(learned, values={name: value.to(learned.rows.device) for name, value in tensors.items()})
