"""Making a plan: before training, measures what the scene does not need."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from statistics import fmean
from typing import Any

import torch

from clod_adapter.cameras import Scene, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.attenuation import dial
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import usable_views
from clod_adapter.losses import psnr
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import render
from clod_adapter.training.dial import require_trainable
from clod_adapter.training.paper import form_of
from clod_adapter.training.plan import NOT_NEEDED, RATES, Decision, Override, Plan

# dB: SH degrees are left out if the PSNR of the training views changes by less without them
LIMIT = 0.02
MEASURED_VIEWS = 8  # evenly spread training views on which that is measured
REQUESTED = "as requested, not measured"
FEW = 0.02  # share of the Gaussians that the farthest views and the smallest budgets have
FARTHER = 1.1  # step of the search for the dial value with that share
FARTHEST = 100.0  # end of that search


@torch.inference_mode(False)
@torch.enable_grad()
def make_plan(
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig | None = None,
    override: Override | None = None,
    progress: Listener | None = None,
) -> Plan:
    """Measures what the training views of ``scene`` need of ``base``, and computes what training
    begins with.

    The same Gaussians, views and settings give the same plan.

    Args:
        override: fixed decisions, which are not measured.
        progress: called in ``Phase.SH_DEGREES``, ``IMPORTANCE``, ``MERGING`` and ``PRUNING_ORDER``.

    Raises:
        ClodError: as ``loop.adapt``.
        Stopped: ``progress`` returned False.
    """
    override = override or Override()
    config = (config or AdaptConfig()).for_views(len(scene.train))
    require_trainable(base, scene, config)
    views = usable_views(base, scene.train)
    seconds = dict[str, float]()
    with _timed(seconds, "bands"):
        degree, decisions = _sh_degree(base, views, override, progress)
    with _timed(seconds, "start"):
        initial = form_of(config).begin(base.without_bands(degree), views, config, progress)
    if added := len(initial) - len(base):
        why = "take over in the distance from the checkpoint's own, which stay as they are"
        decisions.append(Decision("far Gaussians", "added", why, number=float(added)))
    if config.form == "ours" and config.max_sv > 1:
        decisions.append(_far_end(initial, views, config))
    frozen = [name for name in RATES if name in override.leave_out]
    decisions += [Decision(name, "frozen", REQUESTED, name) for name in frozen]
    decisions += [Decision(item, NOT_NEEDED, why) for item, why in scene.left_out]
    rates: dict[str, Any] = {RATES[name]: 0.0 for name in frozen}
    return Plan(base, tuple(decisions), initial, degree, replace(config, **rates), seconds)


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - began


def _sh_degree(
    base: Gaussians,
    views: Sequence[View],
    override: Override,
    progress: Listener | None,
) -> tuple[int, list[Decision]]:
    """The SH degree to train with."""
    highest = base.sh_degree
    views = spread(views, MEASURED_VIEWS)
    if highest == 0:
        return 0, [Decision("SH degrees", NOT_NEEDED, "there are none")]
    if "bands" in override.keep:
        return highest, [Decision("SH degrees", "kept", REQUESTED, "bands")]
    if "bands" in override.leave_out:
        return 0, [Decision("SH degrees", "left out", REQUESTED, "bands")]
    degree = highest
    decisions = list[Decision]()
    plural = "s" if len(views) > 1 else ""
    why = f"change without, {len(views)} training view{plural}"
    for band, loss in sh_degree_losses(base, views, LIMIT):
        what = f"SH degree {band}"
        if band < highest:
            what += f" to {highest}"
        if loss < LIMIT:  # one decision for all that are left out
            degree = band - 1
            decisions = [Decision(what, "left out", why, "bands", loss, "dB")]
        else:
            decisions.append(Decision(what, "kept", why, "bands", loss, "dB"))
        tell(progress, Phase.SH_DEGREES, highest - band + 1, highest)
    return degree, decisions


def _far_end(initial: Gaussians, views: Sequence[View], config: AdaptConfig) -> Decision:
    """The share of the Gaussians that the largest dial value will keep, and the one that would keep
    FEW.
    """
    assert initial.attenuation is not None
    distances = [
        normalized_distances(initial.means, view.camera, initial.attenuation)
        for view in spread(views, MEASURED_VIEWS)
    ]

    def share(s: float) -> float:
        return fmean(int(dial(initial, d, s).keep.sum()) for d in distances) / initial.whole

    reached = f"{share(config.max_sv):.0%} at s = {config.max_sv:g}"
    farther = config.max_sv
    while share(farther) > FEW and farther < FARTHEST:
        farther *= FARTHER
    if config.max_sv < farther < FARTHEST:
        reached += f", {FEW:.0%} with --max-sv {farther:.2g}"
    why = "in the mean of the training views, before training"
    return Decision(reached, "kept", why)


@torch.no_grad()
def sh_degree_losses(
    base: Gaussians,
    views: Sequence[View],
    limit: float,
) -> Iterator[tuple[int, float]]:
    """Effect of removing the highest SH degrees: (degree, dB without it and those above), from the
    highest down.

    The mean over ``views`` of the absolute change of PSNR against the photographs at full detail.
    Ends after the first degree that is not below ``limit``. Degrees whose coefficients are all 0
    have effect 0 without rendering.
    """
    highest = base.without_empty_bands().sh_degree
    yield from ((degree, 0.0) for degree in range(base.sh_degree, highest, -1))

    def quality(degree: int) -> list[float]:
        reduced = base.without_bands(degree)
        return [psnr(render(reduced, view.camera).image, view.image) for view in views]

    expected = quality(highest) if highest else []
    for degree in range(highest, 0, -1):
        pairs = zip(expected, quality(degree - 1), strict=True)
        change = fmean(0.0 if a == b else abs(a - b) for a, b in pairs)  # both may be infinite
        yield degree, change
        if not change < limit:
            return
