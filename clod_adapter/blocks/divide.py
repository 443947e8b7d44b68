"""Division of a scene into blocks, and the training data of each: views, context, target images, shares, settings."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from clod_adapter.adapter import detach
from clod_adapter.cameras import Camera, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.attenuation import dial
from clod_adapter.equation.distances import normalized_distances, typical_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.initialization.importance import coverage, reduced
from clod_adapter.losses import unit
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import splat
from clod_adapter.training.target_count import TargetShare, target_curve

UNSEEN = 0.005  # of a block's coverage over all views, the share that the views it is not trained on may have
LEFT_OUT = 1e-3  # of an image, the share that the Gaussians left out of a block's context may cover
CONTEXT_VIEWS = 32  # most views that the context is chosen in
BARE = 0.01  # of a pixel: where Gaussians cover less, blocks share the error by their sizes too
DIALS = 9  # dial values, evenly spaced in log s, at which the Gaussians kept by the initialization are counted
PASSES, SECOND = 2, 0.25  # over each block, and the share of the steps of the second
LEAST_SEEN = 0.02  # of an image: a block that covers less has too small a part of the whole loss


@dataclass(frozen=True)
class Division:
    """The N Gaussians that are trained, with their initial dial and the ``[N]`` int16 block of each.

    Attributes:
        seen: ``[V, B]`` float32, the share of each view's image that each block covers.
        total: number of Gaussians that target counts are shares of: N and those that a plan leaves out.
    """

    initial: Gaussians
    block: Tensor
    seen: Tensor
    total: int

    @property
    def count(self) -> int:
        return self.seen.shape[1]

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

    A k-d tree: the longest side, between the 5 % and the 95 % quantile, is split at the median (at the corresponding
    quantile where the count is odd).
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
        fewer, (size, larger) = parts // 2, divmod(len(rows), parts)
        cut = fewer * size + min(fewer, larger)
        order = np.argpartition(points[rows, int((high - low).argmax())], cut)
        todo += [(rows[order[:cut]], first, fewer), (rows[order[cut:]], first + fewer, parts - fewer)]
    return torch.from_numpy(block).to(means.device)


def divide(
    initial: Gaussians,
    views: Sequence[View],
    config: AdaptConfig,
    count: int,
    *,
    total: int | None = None,
    progress: Listener | None = None,
) -> Division:
    """Splits the initialized scene, or as much of it as a plan trains, into ``count`` blocks."""
    check_divisible(config)
    assert initial.attenuation is not None
    if initial.attenuation.form == "paper":
        raise ClodError(
            "the checkpoint's dial has the paper's form, whose distances depend on all Gaussians in view: it cannot be "
            "trained in blocks; adapt it whole"
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
        raise ClodError("the paper's form cannot be trained in blocks; leave out --form paper, or --memory")


def context_rows(
    division: Division,
    block: int,
    views: Sequence[View],
    after: Gaussians | None = None,
    progress: Listener | None = None,
) -> Tensor:
    """``[m]`` int64, ascending: the Gaussians of other blocks that any of the views, up to CONTEXT_VIEWS, needs.

    Those left out cover at most LEFT_OUT of each image together, at s = 0, 1 and max_sv. In the second pass, with the
    scene ``after`` the first, other blocks are drawn at the dial.
    """
    own = division.block == block
    scene = after or division.initial
    assert scene.attenuation is not None
    drawn, views = torch.zeros_like(own), spread(views, CONTEXT_VIEWS)
    for k, view in enumerate(views):
        distances = normalized_distances(scene.means, view.camera, scene.attenuation)
        for s in (0.0, 1.0, scene.attenuation.max_sv):
            dialled = dial(scene, distances, s)
            opacities, growth = dialled.drawn, dialled.growth
            if not after:
                opacities = torch.where(own, opacities, scene.opacities)
                growth = torch.where(own, growth, 1)
            covered = coverage(scene, opacities, view.camera, growth)
            ordered = covered[covered > 0].sort().values
            few = int((ordered.double().cumsum(0) <= LEFT_OUT * ordered.double().sum()).sum())
            drawn |= covered > (ordered[few - 1] if few else 0)
        tell(progress, Phase.CONTEXT, k + 1, len(views))
    return (drawn & ~own).nonzero()[:, 0]


def block_target(
    division: Division, block: int, cameras: Sequence[Camera], config: AdaptConfig, *, first: bool
) -> Callable[[float], TargetShare]:
    """The block's target in the count term, by dial value; ``cameras`` are the whole scene's.

    In an undivided run the count term's gradient on each of all N Gaussians is ``loss (eta / target - 1) / (target
    N)``. For a block, ``eta / target`` is the number that it keeps divided by the number that it should keep: ``target
    N`` times its part of the Gaussians that the initialization keeps at this s. The loss is that of the whole image; in
    the first pass the block's is the part that it covers. Views that do not show the block would penalise it too: each
    of its own views also counts for some of those.
    """
    initial, numbers = division.initial, division.views(block)
    assert initial.attenuation is not None
    distances, own = typical_distance(initial.means, cameras, initial.attenuation), division.block == block
    kept = [dial(initial, distances, config.max_sv ** (k / (DIALS - 1))).keep for k in range(DIALS)]
    parts = np.array([float((rows & own).sum() / rows.sum().clamp(min=1)) for rows in kept])
    stands_for = len(division.seen) / len(numbers)
    if first:
        stands_for /= max(float(division.seen[numbers, block].mean()), LEAST_SEEN)
    count, total = int(own.sum()), division.total

    def target(virtual_scale: float) -> TargetShare:
        at = math.log(virtual_scale) / math.log(config.max_sv) * (DIALS - 1)
        whole = target_curve(virtual_scale, config.share, config.exponent) * total
        wanted = max(whole * float(np.interp(at, np.arange(DIALS), parts)), 1.0)
        return TargetShare(wanted / count, stands_for * count / whole)

    return target


@torch.no_grad()
def target_image(gaussians: Gaussians, own: int, view: View) -> Tensor:
    """``[H, W, 3]`` uint8: the checkpoint's image, plus the block's part of its difference from the photograph.

    ``p + w (q - p)`` of image p and photograph q, with w the part of a pixel that the first ``own`` Gaussians cover.
    Over all blocks these add up to 1, so no two blocks correct the same error.
    """
    plain = detach(gaussians)
    image, alpha = splat(plain, gaussians.opacities, view.camera)
    marked = torch.full_like(gaussians.sh0, -0.5 / SH_C0)
    marked[:own] = 0.5 / SH_C0
    mine, _ = splat(plain.replace(sh0=marked, shN=gaussians.shN[:, :0]), gaussians.opacities, view.camera)
    part = ((mine[..., :1] + BARE * own / len(gaussians)) / (alpha[..., None] + BARE)).clamp(0, 1)
    aimed = ((image + part * (unit(view.image, image) - image)).clamp(0, 1) * 255).round().to(torch.uint8)
    return aimed.cpu()  # where photographs are: a device would fill up with them


def block_config(
    division: Division, block: int, config: AdaptConfig, *, first: bool
) -> tuple[AdaptConfig, tuple[float, float]]:
    """The settings of one block in one pass (steps, share of a time budget, own seed), and ``TrainableSubset.span``.

    The second pass takes up the schedule where the first one ends.
    """
    steps = division.steps(block, config)
    light = round(SECOND * steps)  # steps of the second pass
    every = sum(division.steps(other, config) for other in range(division.count))
    own, between = steps - light if first else light, 1 - light / max(steps, 1)
    seed = (config.seed + 1 + block + (0 if first else division.count)) % 2**63
    budget = config.time_budget and config.time_budget * own / max(every, 1) or None
    return replace(config, iters=own, time_budget=budget, seed=seed), (0.0, between) if first else (between, 1.0)
