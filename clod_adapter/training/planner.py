"""Making a plan: before training, measures what the scene does not need."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from clod_adapter.cameras import Scene, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.attenuation import dial
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, has_dial, removal_error
from clod_adapter.losses import psnr
from clod_adapter.progress import Listener, Phase, tell, within
from clod_adapter.rasterizers import ALPHA_MAX
from clod_adapter.render import render, splat
from clod_adapter.training.dial import require_trainable
from clod_adapter.training.far import takes_over, with_far
from clod_adapter.training.gate import decibels_below, squared_error
from clod_adapter.training.loop import training_views
from clod_adapter.training.paper import form_of
from clod_adapter.training.plan import NOT_NEEDED, RATES, Decision, Override, Plan, psnr_change
from clod_adapter.training.pseudo_views import PseudoView

# dB: the share kept at s = 1 loses less on views that the errors are not from. The checkpoint was trained on them too,
# and fits them better than others: views that it never saw lose a half to a tenth of that (docs/method.md).
SHARE_LIMIT = 0.03
LIMIT = 0.02  # dB: SH degrees and Gaussians are left out if the PSNR of the training views changes by less without them
VIEWS = 8  # evenly spread training views on which that is measured
REQUESTED = "as requested, not measured"
FEW = 0.02  # share of the Gaussians that the farthest views and the smallest budgets have
FARTHER, FARTHEST = 1.1, 100.0  # step and end of the search for the dial value with that share


@torch.inference_mode(False)
@torch.enable_grad()
def make_plan(
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig | None = None,
    override: Override | None = None,
    progress: Listener | None = None,
    *,
    far: bool = True,
) -> Plan:
    """Measures what the training views of ``scene`` need of ``base``, and computes the initial sigma_d.

    The same Gaussians, views and settings give the same plan.

    Args:
        override: fixed decisions, which are not measured, except which Gaussians are unseen.
        far: whether far Gaussians may be added (``far.with_far``); blocks have none.
        progress: called in ``Phase.SH_DEGREES``, ``IMPORTANCE`` and ``PRUNING_ORDER``.

    Raises:
        ClodError: as ``loop.adapt``.
        Stopped: ``progress`` returned False.
    """
    config, override = config or AdaptConfig(), override or Override()
    far = far and takes_over(base, config)
    config = config.for_views(len(scene.train), far or base.near is not None)
    require_trainable(base, scene, config)
    views, watched = training_views(base, scene.train, config, far)
    placed = all(isinstance(view, PseudoView) for view in scene.train)  # there are no photographs
    seconds, kept, error = dict[str, float](), None, None
    with _timed(seconds, "bands"):
        degree, decisions = _sh_degree(base, views, override, progress)
    few = base.without_bands(degree)
    if reason := _not_measured(base, config, override):
        decisions.append(Decision("unseen Gaussians", "kept", None, "", reason, "unseen"))
    else:
        error, kept, config, found = _measured(few, views, watched, config, placed, far, seconds, progress)
        decisions += found
    with _timed(seconds, "start"):
        begin = with_far if far else form_of(config).initial
        initial = begin(few, views, config, progress, error)
    if far:
        added, why = float(len(initial) - initial.whole), "far Gaussians stand for those that stay as they are near"
        decisions.append(Decision("far Gaussians", "added", added, "", f"{why} by"))
    decisions += _far_end(initial, views, config)
    frozen = [name for name in RATES if name in override.leave_out]
    decisions += [Decision(name, "frozen", None, "", REQUESTED, name) for name in frozen]
    decisions += [Decision(item, NOT_NEEDED, None, "", why) for item, why in scene.left_out]
    rates: dict[str, Any] = {RATES[name]: 0.0 for name in frozen}
    return Plan(tuple(decisions), initial, kept, degree, replace(config, **rates), seconds)


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - began


def _sh_degree(
    base: Gaussians, views: Sequence[View], override: Override, progress: Listener | None
) -> tuple[int, list[Decision]]:
    """The SH degree to train with."""
    highest, views = base.sh_degree, spread(views, VIEWS)
    if highest == 0:
        return 0, [Decision("SH degrees", NOT_NEEDED, None, "", "there are none")]
    if "bands" in override.keep:
        return highest, [Decision("SH degrees", "kept", None, "", REQUESTED, "bands")]
    if "bands" in override.leave_out:
        return 0, [Decision("SH degrees", "left out", None, "", REQUESTED, "bands")]
    degree, decisions = highest, list[Decision]()
    for band, loss in sh_degree_losses(base, views, LIMIT):
        what, them = (f"{band}", "it") if band == highest else (f"{band} to {highest}", "them")
        why = f"change without {them}, {_counted(len(views))}"
        if loss < LIMIT:  # one decision for all that are left out
            degree, decisions = band - 1, []
        verdict = "left out" if loss < LIMIT else "kept"
        decisions.append(Decision(f"SH degree {what}", verdict, loss, "dB", why, "bands"))
        tell(progress, Phase.SH_DEGREES, highest - band + 1, highest)
    return degree, decisions


def _not_measured(base: Gaussians, config: AdaptConfig, override: Override) -> str:
    """Why unseen Gaussians are kept without a measurement; empty if they are measured."""
    if "unseen" in override.keep:
        return REQUESTED
    if "unseen" in override.leave_out:
        return ""
    if has_dial(base):
        return "not measured: its dial shows other Gaussians at other dial values"
    if not form_of(config).measured:
        return "not measured: in the paper's form every Gaussian begins with the same sigma_d"
    return ""


def _measured(
    few: Gaussians, views: Sequence[View], watched: Sequence[View], config: AdaptConfig, placed: bool, far: bool,
    seconds: dict[str, float], progress: Listener | None,
) -> tuple[Tensor, Tensor | None, AdaptConfig, list[Decision]]:  # fmt: skip
    """``[N]`` what removing each Gaussian costs, the rows to train (None for all), and the share kept at s = 1.

    The fold decides about the share: on the views that errors are from, Gaussians seem needless that others need.
    """
    fold = spread(views, min(VIEWS, len(views) // 4))
    some = spread([view for view in views if view not in fold], MOST_VIEWS - len(fold))
    every = [*views, *(view for view in watched if view not in views)]
    others = [] if placed else [view for view in every if view not in some and view not in fold]
    used = len(some) + len(fold)
    told = [within(progress, done, len(every)) for done in (0, len(some), used)]
    with _timed(seconds, "start"):
        elsewhere = removal_error(few, some, seed=config.seed, progress=told[0])
        here = removal_error(few, fold, seed=config.seed, progress=told[1])
        error = (elsewhere * len(some) + here * len(fold)) / used
    with _timed(seconds, "unseen"):
        shown = seen(few, others, error, config.seed, told[2])
    gone, why = len(few) - int(shown.sum()), f"of {len(few):,} change no pixel of {_counted(len(every))}"
    if placed:  # a Gaussian that no placed camera shows is as important as others of its opacity and size
        error, elsewhere = (supposed_error(few, found, shown) for found in (error, elsewhere))
        why += ", which do not show everything"
    if far:
        why += "; near Gaussians stay"
    kept = (
        None if placed or far or gone in (0, len(few)) else shown
    )  # in an invisible checkpoint no row can be preferred
    verdict, effect = ("kept", float(gone) if placed or far else 0.0) if kept is None else ("left out", float(gone))
    name = "unseen" if (placed or kept is not None) and not far else ""
    decisions = [Decision("unseen Gaussians", verdict, effect, "", why, name)]
    if config.start_share is None and config.max_sv != 1 and not far:
        fold = fold or some[:VIEWS]
        with _timed(seconds, "share"):
            share, loss = needed_share(few, fold, elsewhere, SHARE_LIMIT)
        why = f"lost in {_counted(len(fold))} without those that matter least in the others, untrained"
        decisions.append(Decision(f"{share:.0%} of the Gaussians at s = 1", "kept", loss, "dB", why))
        config = replace(config, start_share=share)
    return error, kept, config, decisions


def _far_end(initial: Gaussians, views: Sequence[View], config: AdaptConfig) -> list[Decision]:
    """The share of the Gaussians that the largest dial value will keep, and the one that would keep FEW."""
    if config.form == "paper" or config.max_sv == 1:
        return []
    assert initial.attenuation is not None
    cameras = [view.camera for view in spread(views, VIEWS)]
    distances = [normalized_distances(initial.means, camera, initial.attenuation) for camera in cameras]

    def share(s: float) -> float:
        return fmean(int(dial(initial, d, s).keep.sum()) for d in distances) / initial.whole

    reached = f"{share(config.max_sv):.0%} at s = {config.max_sv:g}"
    farther = config.max_sv
    while share(farther) > FEW and farther < FARTHEST:
        farther *= FARTHER
    if config.max_sv < farther < FARTHEST:
        reached += f", {FEW:.0%} with --max-sv {farther:.2g}"
    return [Decision(reached, "kept", None, "", "in the mean of the training views, before training")]


def supposed_error(gaussians: Gaussians, error: Tensor, shown: Tensor) -> Tensor:
    """``[N]`` the error; of one that is not shown that of a shown one of equal ``opacity^2 * area``, in the median."""
    area = gaussians.log_scales.sum(1) - gaussians.log_scales.amin(1)
    expected = gaussians.opacities.square() * (area - area.median()).clamp(-30, 30).exp()
    measured = shown & (error > 0)
    if not bool(measured.any()):
        return error
    return torch.where(shown, error, expected * (error[measured] / expected[measured]).median())


def _counted(views: int) -> str:
    return f"{views:,} training view{'s' if views > 1 else ''}"


@torch.no_grad()
def sh_degree_losses(base: Gaussians, views: Sequence[View], limit: float) -> Iterator[tuple[int, float]]:
    """Effect of removing the highest SH degrees: (degree, dB without it and those above), from the highest down.

    The mean over ``views`` of the absolute change of PSNR against the photographs at full detail. Ends after the first
    degree that is not below ``limit``. Degrees whose coefficients are all 0 have effect 0 without rendering.
    """
    used = base.without_empty_bands().sh_degree
    yield from ((degree, 0.0) for degree in range(base.sh_degree, used, -1))

    def quality(degree: int) -> list[float]:
        less = base.without_bands(degree)
        return [psnr(render(less, view.camera).image, view.image) for view in views]

    with_all = quality(used) if used else []
    for degree in range(used, 0, -1):
        change = fmean(abs(psnr_change(a, b)) for a, b in zip(with_all, quality(degree - 1), strict=True))
        yield degree, change
        if not change < limit:
            return


def seen(base: Gaussians, others: Sequence[View], error: Tensor, seed: int, progress: Listener | None = None) -> Tensor:
    """``[N]`` bool, which Gaussians change any pixel of any of the views that ``error`` is from, and of the others.

    An image is linear in each opacity, so removing a Gaussian changes nothing if no pixel has a derivative by its
    opacity. Rasterizers clamp alpha, where it has no derivative: Gaussians that opaque count as seen.
    """
    moves = (error > 0) | (removal_error(base, others, seed=seed, progress=progress) > 0)
    return moves | (base.opacities > ALPHA_MAX)


@torch.no_grad()
def needed_share(base: Gaussians, views: Sequence[View], error: Tensor, limit: float) -> tuple[float, float]:
    """The smallest share of the Gaussians that loses less than ``limit`` dB, in hundredths, and that loss.

    In (0.5, 1], by bisection. The Gaussians with the largest removal error remain, unattenuated. The loss is
    ``gate.decibels_below`` the base.
    """
    order = error.argsort(descending=True, stable=True)

    def errors(percent: int) -> list[float]:
        less = base.opacities.clone()
        less[order[max(round(percent / 100 * len(base)), 1) :]] = 0  # neither sorted nor drawn; a copy is large
        return [squared_error(splat(base, less, view.camera)[0], view) for view in views]

    whole = errors(100)
    low, high, found = 50, 100, 0.0
    while high - low > 1:
        middle = (low + high) // 2
        lost = decibels_below(errors(middle), whole)
        low, high, found = (low, middle, lost) if lost < limit else (middle, high, found)
    return high / 100, found
