"""The robustness experiment: checkpoints of any origin, adapted at several ranges of the dial (CLoD-GS section 4.4).

A cell is one checkpoint at one range, or its baseline. Cells know nothing of each other, so that they can be measured
at different times.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from clod_adapter.adapter import Adapter, detach, extract
from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.baselines import by_opacity
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.gaussians import Gaussians
from clod_adapter.origin import NOWHERE, Origin
from clod_adapter.training.loop import Progress, adapt

# Shares of the untouched base that its baseline keeps.
BASELINE_SHARES = (1.0, 0.8, 0.62, 0.48, 0.35, 0.25, 0.18, 0.12, 0.08, 0.05)
OPACITY_EDGES = tuple(k / 40 for k in range(41))
LOG_SIGMA_EDGES = tuple(-3 + k / 10 for k in range(61))  # log10 of sigma_d; what lies beyond counts in the end bins


@dataclass(frozen=True)
class Outcome:
    """A cell that was measured.

    Attributes:
        rows: one a dial value (of a range) or count (of a baseline), as ``evaluate.Row.as_dict`` gives them.
        distribution: ``distribution`` of the Gaussians.
        adapter: what was learned; None of a baseline.
        seconds: wall time of the adaptation, importance pass included; 0 of a baseline.
    """

    rows: list[dict[str, float]]
    distribution: dict[str, Any]
    adapter: Adapter | None = None
    seconds: float = 0.0


def adapt_at_range(
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig,
    virtual_scales: Sequence[float],
    *,
    fingerprint: str,
    origin: Origin = NOWHERE,
    follow: Callable[[Progress], None] | None = None,
    measured: Callable[[int, int], None] | None = None,
) -> Outcome:
    """Adapts ``base`` at the range ``[1, config.max_sv]`` and measures the result on the held-out views.

    Args:
        base: the checkpoint; a dial it may have plays no part.
        virtual_scales: dial values to measure at; those above ``max_sv`` show how it goes on beyond the range.
        fingerprint: of the checkpoint file; origin: what its means are relative to; both for the adapter.
        follow: progress of the adaptation; measured: of the measurement, as (frames done, frames in all).

    Raises:
        KeyboardInterrupt: also where ``adapt`` would return what it has: half an adaptation is no cell.
        ClodError: a step's loss is not finite, likewise.
    """
    base = detach(base)
    adapted = adapt(base, scene, config, follow)
    if adapted.failed:
        raise ClodError(f"max_sv {config.max_sv:g}: {adapted.failed}; leave this range or checkpoint out")
    if adapted.interrupted:
        raise KeyboardInterrupt
    adapter = extract(base, adapted.gaussians, fingerprint=fingerprint, config=asdict(config), origin=origin)
    result = adapter.apply(base)
    rows = [row.as_dict() for row in evaluate(result, scene.test, virtual_scales, progress=measured)]
    return Outcome(rows, distribution(result), adapter, adapted.start_seconds + adapted.seconds)


def baseline(
    base: Gaussians,
    views: Sequence[View],
    shares: Sequence[float] = BASELINE_SHARES,
    *,
    measured: Callable[[int, int], None] | None = None,
) -> Outcome:
    """The untouched base with only its most opaque Gaussians kept, nothing tuned: one row a share."""
    base, rows = detach(base), []
    for k, share in enumerate(shares):

        def report(done: int, total: int, before: int = k) -> None:
            if measured:
                measured(before * total + done, len(shares) * total)

        pruned = most_opaque(base, max(1, round(share * len(base))))
        (row,) = evaluate(pruned, views, [1.0], progress=report)
        rows.append(row.as_dict() | {"kept_share": len(pruned) / len(base)})
    return Outcome(rows, distribution(base))


def most_opaque(gaussians: Gaussians, count: int) -> Gaussians:
    """The ``count`` Gaussians of highest opacity, in their order."""
    return gaussians.select(by_opacity(gaussians)[:count].sort().values)


def distribution(gaussians: Gaussians) -> dict[str, Any]:
    """Histograms: ``opacity`` over [0, 1], and of a dial also ``log10_sigma_d``; each has ``edges`` and ``shares``.

    Shares are of all Gaussians and sum to 1. A value beyond the edges counts in the bin at that end.
    """
    found = {"opacity": _histogram(gaussians.opacities, OPACITY_EDGES)}
    if gaussians.sigma_d is not None:
        found["log10_sigma_d"] = _histogram(gaussians.sigma_d.clamp(min=1e-30).log10(), LOG_SIGMA_EDGES)
    return found


def _histogram(values: Tensor, edges: Sequence[float]) -> dict[str, list[float]]:
    inner = torch.tensor(edges[1:-1])
    counts = torch.bincount(torch.bucketize(values.detach().cpu().float(), inner, right=True), minlength=len(edges) - 1)
    return {"edges": list(edges), "shares": (counts / max(len(values), 1)).tolist()}


def scene_fingerprint(scene: Scene, progress: Callable[[int, int], None] | None = None) -> str:
    """SHA-256, hex, of the photographs' pixels, their cameras and the split: the same capture wherever it lies.

    Args:
        progress: called with the number of photographs done after each, and of all of them.
    """
    digest, done = hashlib.sha256(), 0
    for views in (scene.train, scene.test):
        digest.update(f"{len(views)};".encode())
        for view in views:
            for tensor in (view.camera.viewmat, view.camera.K, view.image):
                digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
            done += 1
            if progress:
                progress(done, len(scene.train) + len(scene.test))
    return digest.hexdigest()
