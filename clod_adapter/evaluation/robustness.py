"""Cells of the robustness experiment: a checkpoint adapted at one range of the dial (CLoD-GS 4.4),
or its baseline.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from clod_adapter.adapter import Adapter, detach
from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.evaluate import evaluate_all
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.progress import Listener, Progress, Stopped
from clod_adapter.training.planner import make_plan
from clod_adapter.training.pseudo_views import PseudoView, add_pseudo_views
from clod_adapter.training.state import extract_adapter

# Shares of the unadapted base that its baseline keeps.
BASELINE_SHARES = (1.0, 0.8, 0.62, 0.48, 0.35, 0.25, 0.18, 0.12, 0.08, 0.05)
OPACITY_EDGES = tuple(k / 40 for k in range(41))
# log10 of sigma_d; the end bins include values outside
LOG_SIGMA_EDGES = tuple(-3 + k / 10 for k in range(61))


@dataclass(frozen=True)
class CellResult:
    """The result of a cell, with a row for each dial value of a range, or share of a baseline,
    which has no adapter.
    """

    rows: list[dict[str, float]]
    distribution: dict[str, Any]
    adapter: Adapter | None = None
    seconds: float = 0.0


def adapt_at_range(
    file: Checkpoint,
    scene: Scene,
    config: AdaptConfig,
    virtual_scales: Sequence[float],
    progress: Listener,
) -> CellResult:
    """Adapts to ``[1, config.max_sv]``, and measures dial values, also beyond it; Stopped if that
    is not completed.
    """
    base = detach(file.gaussians)
    scene = add_pseudo_views(base, scene, config.seed, progress)
    config = config.for_views(len(scene.train))
    adapted = make_plan(base, scene, config, progress=progress).adapt(scene, progress)
    if adapted.failed:
        raise ClodError(
            f"max_sv {config.max_sv:g}: {adapted.failed}; leave this range or checkpoint out"
        )
    if adapted.interrupted:
        raise Stopped(f"stopped at step {adapted.steps}")
    adapter = extract_adapter(replace(file, gaussians=base), adapted, config)
    result = adapter.apply(base)
    rows = [row.as_dict() for row in evaluate_all(result, scene.test, virtual_scales, progress)]
    return CellResult(rows, distribution(result), adapter, adapted.start_seconds + adapted.seconds)


def baseline(
    base: Gaussians,
    views: Sequence[View],
    shares: Sequence[float],
    progress: Listener,
) -> CellResult:
    """The unadapted base with only its most opaque Gaussians: one row per share."""
    base = detach(base)
    rows = list[dict[str, float]]()
    order = base.opacity_logits.argsort(descending=True, stable=True)

    def tell_all(now: Progress) -> bool | None:
        done = len(rows) * len(views) + now.done
        return progress(replace(now, done=done, total=len(shares) * len(views)))

    for share in shares:
        count = max(1, round(share * len(base)))
        rows_kept = order[:count].sort().values  # in their own order
        pruned = base.select(rows_kept)
        (row,) = evaluate_all(pruned, views, [1.0], tell_all)
        rows.append(row.as_dict() | {"kept_share": len(pruned) / len(base)})
    return CellResult(rows, distribution(base))


def distribution(gaussians: Gaussians) -> dict[str, Any]:
    """Histograms with ``edges`` and ``shares``: ``opacity`` over [0, 1], and ``log10_sigma_d`` if
    there is a dial.
    """
    found = {"opacity": _histogram(gaussians.opacities, OPACITY_EDGES)}
    if gaussians.sigma_d is not None:
        powers = gaussians.sigma_d.clamp(min=1e-30).log10()
        found["log10_sigma_d"] = _histogram(powers, LOG_SIGMA_EDGES)
    return found


def _histogram(values: Tensor, edges: Sequence[float]) -> dict[str, list[float]]:
    inside = values.detach().cpu().clamp(edges[0], edges[-1])
    counts, _ = np.histogram(inside, edges)
    return {"edges": list(edges), "shares": (counts / len(values)).tolist()}


def scene_fingerprint(scene: Scene) -> str:
    """SHA-256, hex, of photographs' pixels, cameras and split; a pseudo view's pixels are those of
    its checkpoint.
    """
    digest = hashlib.sha256()
    for views in (scene.train, scene.test):
        digest.update(f"{len(views)};".encode())
        for view in views:
            pixels = () if isinstance(view, PseudoView) else (view.image,)
            for tensor in (view.camera.viewmat, view.camera.K, *pixels):
                digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
