"""Scenes that do not fit: adapting block by block, each with the views that see it, the rest of the scene frozen.

In a first pass each block is trained against the *checkpoint* of the others: they are drawn as if they had no dial, at
every dial value, which is what their own training aims at, and the block's pictures to be are the photographs as far as
it can answer for them (``target``). So no block makes up for what another one will. (Against the others' start, at the
same dial value, each brightens what all have faded: pictures of the merged result were 8 to 11 dB worse,
docs/chunks.md.) In a second pass each goes on beside the others as the first has left them, at the dial, which brings
the blocks into accord. Within a pass the jobs are independent, and their order does not matter; what they learn
is put together by rows.

What an undivided run has for all of the scene, a block has its share of:

- The start (importance, order of leaving, sigma_d, tau) is of the whole scene.
- The unit of position steps is the extent of all cameras.
- A block takes as many steps as the undivided run takes of the views that see it, so that each Gaussian is stepped as
  often. All blocks together take more, as a view may see several.
- The count law is of all Gaussians. A block is asked for its own share of the Gaussians that the start keeps in the
  same view at the same dial value, as far as those add up to the law (``Quotas``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.attenuation import attenuate, normalized_distances
from clod_adapter.cameras import Camera, Scene, View, camera_extent
from clod_adapter.config import AdaptConfig
from clod_adapter.counting import Quota, count_law
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.importance import spread, start
from clod_adapter.io.image_cache import ImageCache
from clod_adapter.losses import unit
from clod_adapter.objective import Part
from clod_adapter.render import splat
from clod_adapter.train import adapt
from clod_adapter.training_state import Adapted, Progress, TrainingState

UNSEEN = 0.005  # of what all views show of a block, the share that those it is not trained on may show
LEFT_OUT = 1e-3  # of a picture, the share that those Gaussians may show that are left out of it
CONTEXT_VIEWS = 32  # that are looked at for what a block is drawn with, at most
SMALLER = 4  # times, the pictures that tell which views see which blocks
BARE = 0.01  # of a pixel: where Gaussians show less, blocks answer for it by their size too
SECOND = 0.25  # of the steps, those of the second pass
LEAST_SEEN = 0.02  # of a picture: a block that shows less tells too little of the loss of the whole
DIALS = 9  # at which the start's Gaussians are counted


@dataclass(frozen=True)
class Division:
    """A scene in blocks, and what all of them begin from.

    Attributes:
        begun: the Gaussians with the sigma_d that training begins from.
        block: ``[N]`` int16, the block of each.
        seen: ``[V, B]`` float32, the share of each view's picture that is of each block.
        kept: ``[V, DIALS]`` float32, how many Gaussians the start keeps in each view, at even steps of log s.
        extent: of all cameras, world units.
    """

    begun: Gaussians
    block: Tensor
    seen: Tensor
    kept: Tensor
    extent: float

    @property
    def count(self) -> int:
        """Of blocks."""
        return self.seen.shape[1]

    @property
    def passes(self) -> int:
        """How often each block is trained; one that is alone has nothing to come into accord with."""
        return 2 if self.count > 1 else 1

    def rows(self, block: int) -> Tensor:
        """``[n]`` int64, ascending: the Gaussians of a block."""
        return (self.block == block).nonzero()[:, 0]

    def views(self, block: int) -> list[int]:
        """The fewest views that show all but UNSEEN of what is seen of a block, ascending; at least one."""
        shares, order = self.seen[:, block].double().sort(descending=True, stable=True)
        covered = shares.cumsum(0)
        fewest = int((covered < (1 - UNSEEN) * covered[-1]).sum()) + 1
        return sorted(order[:fewest].tolist())

    def steps(self, block: int, config: AdaptConfig) -> int:
        """Of a block, both passes: as many as an undivided run takes of the views that see it."""
        return math.ceil(config.iters * len(self.views(block)) / len(self.seen))


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


def split(means: Tensor, count: int) -> Tensor:
    """``[N]`` int16: which of ``count`` blocks each centre is in; blocks differ by at most one in size.

    A k-d tree: the longest side is halved at the median (at the fitting quantile where the count is odd). Sides are
    taken between the 5 % and the 95 % quantile, so that a few far Gaussians do not decide where a scene is cut.

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
    """How many of ``total`` the first ``fewer`` of ``parts`` even parts have."""
    whole, rest = divmod(total, parts)
    return fewer * whole + min(fewer, rest)


def divide(
    base: Gaussians,
    views: Sequence[View],
    config: AdaptConfig,
    count: int,
    progress: Callable[[str, int, int], None] | None = None,
) -> Division:
    """Splits a scene into ``count`` blocks and takes the start, of the whole scene, that all of them begin from.

    Args:
        views: ``importance.seeing`` of the training views.
        progress: as ``importance.start`` calls it, and with "blocks" and the number of views looked at, and of all.

    Raises:
        ClodError: the settings are some that blocks cannot be trained with, or there are fewer Gaussians than blocks.
    """
    check_divisible(config)
    block = split(base.means, count)
    begun = start(base.without_empty_bands(), views, config, progress)
    assert begun.attenuation is not None
    if begun.attenuation.normalizer != "scene":
        raise ClodError(
            f"the checkpoint's dial has the normaliser {begun.attenuation.normalizer}, whose distances depend on all "
            "Gaussians in view: it cannot be trained in chunks; adapt it whole"
        )
    seen, kept = torch.empty(len(views), count), torch.empty(len(views), DIALS)
    for k, view in enumerate(views):
        shown = coverage(begun, begun.opacities, _smaller(view.camera)).double()
        seen[k] = (shown.new_zeros(count).index_add_(0, block.long(), shown) / shown.sum().clamp(min=1e-9)).float()
        kept[k] = torch.tensor(_kept(begun, view, dial_grid(config)))
        if progress:
            progress("blocks", k + 1, len(views))
    begun = base.replace(sigma_d=begun.sigma_d, attenuation=begun.attenuation)
    extent = camera_extent([view.camera for view in views]) or begun.attenuation.scene_distance  # type: ignore[union-attr]
    return Division(begun, block, seen, kept, extent)


def check_divisible(config: AdaptConfig) -> None:
    """Raises the ClodError of settings that need all of a scene at once."""
    if config.count_term == "paper" or config.normalizer != "scene":
        raise ClodError(
            "the paper's form cannot be trained in chunks: its count and its distances are of all Gaussians at once; "
            "leave out --form paper, or --memory"
        )


def dial_grid(config: AdaptConfig) -> list[float]:
    """DIALS dial values from 1 to ``max_sv`` in even steps of their logarithm."""
    return [config.max_sv ** (k / (DIALS - 1)) for k in range(DIALS)]


@torch.no_grad()
def _kept(gaussians: Gaussians, view: View, dials: Sequence[float]) -> list[float]:
    """How many Gaussians are kept in a view at some dial values."""
    assert gaussians.sigma_d is not None and gaussians.attenuation is not None
    distances = normalized_distances(gaussians.means, view.camera, gaussians.attenuation)
    given = gaussians.opacity_logits, gaussians.sigma_d, distances
    return [float(attenuate(*given, s, gaussians.attenuation).keep.sum()) for s in dials]


def coverage(gaussians: Gaussians, opacities: Tensor, camera: Camera) -> Tensor:
    """``[N]`` how many pixels each Gaussian covers: the sum over the picture of its transmittance times its alpha.

    The gradient of a picture by the colours that it is mixed from.
    """
    grey = gaussians.sh0.new_zeros(gaussians.sh0.shape).requires_grad_()
    plain = gaussians.replace(sh0=grey, shN=gaussians.shN[:, :0], sigma_d=None, attenuation=None)
    image, _ = splat(plain, opacities, camera)
    (gradient,) = torch.autograd.grad(image[..., 0].sum(), grey)
    return gradient[:, 0, 0] / SH_C0


def _smaller(camera: Camera) -> Camera:
    """The same view in fewer pixels."""
    width, height = (max(size // SMALLER, 1) for size in (camera.width, camera.height))
    shrink = camera.K.new_tensor([[width / camera.width], [height / camera.height], [1.0]])
    return replace(camera, K=camera.K * shrink, width=width, height=height)


def beside(
    division: Division,
    block: int,
    views: Sequence[View],
    after: Gaussians | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Tensor:
    """``[m]`` int64, ascending: the other Gaussians, but for those that show too little in any of the views.

    In a picture they show at most LEFT_OUT of it together, at s = 1 and at the largest dial value.

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
        if progress:
            progress(k + 1, len(views))
    return (drawn & ~own).nonzero()[:, 0]


def _least_shown(shown: Tensor) -> Tensor:
    """0-d, the coverage up to which all Gaussians together show at most LEFT_OUT of the picture."""
    ordered = shown[shown > 0].sort().values
    few = int((ordered.double().cumsum(0) <= LEFT_OUT * ordered.double().sum()).sum())
    return ordered[few - 1] if few else shown.new_zeros(())


class Quotas:
    """What the count law asks of one block: ``objective.Part.quota``.

    Undivided, the law presses with ``loss (eta / law - 1) / (law N)`` on each of all N Gaussians. Here ``eta / law`` is
    taken to be what the block keeps by what it should: ``law N`` times its part of those that the start keeps in this
    view at this s. So at the start each block is pressed as the whole is, and an allocation that it has found stays.
    The loss is that of the whole picture: in the first pass what the block answers for by its part of the picture.
    Views that do not show the block would press on it too: each of its own stands for some of them.
    """

    def __init__(
        self, division: Division, block: int, views: Sequence[View], config: AdaptConfig, *, first: bool
    ) -> None:
        self.views, self.config, self.all = tuple(views), config, len(division.begun)
        rows, numbers, dials = division.rows(block), division.views(block), dial_grid(config)
        own = division.begun.select(rows)
        self.count, each = len(rows), len(division.seen) / len(numbers)
        self._of = {}
        for view, k in zip(self.views, numbers, strict=True):
            parts = np.array(_kept(own, view, dials)) / division.kept[k].clamp(min=1).numpy()
            stands_for = each / max(float(division.seen[k, block]), LEAST_SEEN) if first else each
            self._of[id(view)] = parts, stands_for

    def __call__(self, view: View, virtual_scale: float, loss: float) -> Quota:
        config, (parts, stands_for) = self.config, self._of[id(view)]
        at = math.log(virtual_scale) / math.log(config.max_sv) * (DIALS - 1)
        part = float(np.interp(at, np.arange(DIALS), parts))
        law = count_law(virtual_scale, config.start_share, config.exponent)
        wanted = max(law * self.all * part, 1.0)
        return Quota(wanted / self.count, stands_for * self.count / (law * self.all))


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


def adapt_chunk(
    division: Division,
    views: Sequence[View],
    config: AdaptConfig,
    block: int,
    *,
    after: Gaussians | None = None,
    progress: Callable[[Progress], None] | None = None,
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
        What it learned, and the outcome of ``train.adapt``, whose first Gaussians are those of the block.
    """

    def report(done: int, total: int) -> None:
        if progress:
            progress(Progress("beside", done, total, 0.0, done / total, math.nan, lambda: division.begun))

    scene = after or division.begun
    rows, own = division.rows(block), [views[k] for k in division.views(block)]
    gaussians = scene.select(torch.cat([rows, beside(division, block, own, after, report)]))
    if after is None:
        own = [_aimed(gaussians, len(rows), view, cache) for view in own]
    quotas = Quotas(division, block, own, config, first=after is None)
    part = Part(len(rows), division.extent, quotas, rest_in_full=after is None)
    settings = config_of(division, block, config, first=after is None)
    adapted = adapt(gaussians, Scene(tuple(own), ()), settings, progress, resume, part=part)
    values = {name: value[: len(rows)] for name, value in adapted.gaussians.tensors().items()}
    changed = {
        name: value.clone() for name, value in values.items()
        if name == "sigma_d" or not torch.equal(value, getattr(division.begun, name)[rows])
    }  # fmt: skip
    return Learned(rows, changed, adapted.steps, adapted.seconds), adapted


def _aimed(gaussians: Gaussians, own: int, view: View, cache: ImageCache | None) -> View:
    """The view with its ``target`` in place of the photograph."""
    aimed = View(view.camera, target(gaussians, own, view))
    return cache.store(aimed, lambda: target(gaussians, own, view)) if cache else aimed


def merge(division: Division, learned: Sequence[Learned]) -> Gaussians:
    """The scene with what its blocks have learned.

    Raises:
        ClodError: a Gaussian is in none of them, or in two.
    """
    times = torch.zeros_like(division.block, dtype=torch.int32)
    for part in learned:
        times[part.rows] += 1
    if not bool((times == 1).all()):
        raise ClodError(f"{int((times != 1).sum())} Gaussians are in no chunk or in two; give each chunk once")
    merged = {}
    for name in (*ATTRIBUTES, "sigma_d"):
        if any(name in part.values for part in learned):
            merged[name] = getattr(division.begun, name).clone()
            for part in learned:
                if name in part.values:
                    merged[name][part.rows] = part.values[name]
    return division.begun.replace(**merged)
