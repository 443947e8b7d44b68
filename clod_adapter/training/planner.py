"""Making a plan: before training, measures what the scene does not need."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from statistics import fmean
from typing import Any, NamedTuple

import torch
from torch import Tensor

from clod_adapter.cameras import Scene, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, has_dial, removal_error
from clod_adapter.losses import psnr
from clod_adapter.progress import Listener, Phase, tell, within
from clod_adapter.rasterizers import ALPHA_MAX
from clod_adapter.render import render, splat
from clod_adapter.training.dial import require_trainable
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


@torch.inference_mode(False)
@torch.enable_grad()
def make_plan(
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig | None = None,
    override: Override | None = None,
    progress: Listener | None = None,
) -> Plan:
    """Measures what the training views of ``scene`` need of ``base``, and computes the initial sigma_d.

    The same Gaussians, views and settings give the same plan.

    Args:
        override: fixed decisions, which are not measured, except which Gaussians are unseen.
        progress: called in ``Phase.SH_DEGREES``, ``IMPORTANCE`` and ``PRUNING_ORDER``.

    Raises:
        ClodError: as ``loop.adapt``.
        Stopped: ``progress`` returned False.
    """
    return _Planner(base, scene, config or AdaptConfig(), override or Override(), progress).plan()


class _Errors(NamedTuple):
    """What removing each Gaussian costs.

    Attributes:
        error: ``[N]`` ``removal_error`` of up to MOST_VIEWS views; seen: ``[N]`` bool, whether any view shows it.
        elsewhere: ``[N]`` of the views that are not in the fold; fold: views that decide about the share. Measured on
            the views that the errors are from, Gaussians seem to be needless that other views need.
        views: the number of all.
    """

    error: Tensor
    seen: Tensor
    elsewhere: Tensor
    fold: Sequence[View]
    views: int


class _Planner:
    """Makes one plan."""

    def __init__(
        self, base: Gaussians, scene: Scene, config: AdaptConfig, override: Override, progress: Listener | None
    ) -> None:
        self.base, self.scene, self.override, self.progress = base, scene, override, progress
        self.config = config.for_views(len(scene.train))
        require_trainable(base, scene, config)
        self.views, self.watched = training_views(base, scene.train, self.config)
        self.placed = all(isinstance(view, PseudoView) for view in scene.train)  # there are no photographs
        self.decisions: list[Decision] = []
        self.seconds: dict[str, float] = {}

    def plan(self) -> Plan:
        with self._time("bands"):
            degree = self._sh_degree()
        few = self.base.without_bands(degree)
        errors = self._errors(few)
        kept = self._unseen(errors)
        config = self._share(few, errors)
        with self._time("start"):
            initial = form_of(config).initial(few, self.views, config, self.progress, errors and errors.error)
        config = self._freeze(config)
        for item, reason in self.scene.left_out:
            self._decide(item, NOT_NEEDED, reason)
        return Plan(tuple(self.decisions), initial, kept, degree, config, self.seconds)

    def _sh_degree(self) -> int:
        """The SH degree to train with."""
        base, views = self.base, spread(self.views, VIEWS)
        degree = base.sh_degree
        if degree == 0:
            self._decide("SH degrees", NOT_NEEDED, "there are none")
            return 0
        if "bands" in self.override.keep | self.override.leave_out:
            kept = "bands" in self.override.keep
            self._decide("SH degrees", "kept" if kept else "left out", REQUESTED, "bands")
            return degree if kept else 0
        for band, loss in sh_degree_losses(base, views, LIMIT):
            gone = loss < LIMIT
            if gone and degree < base.sh_degree:
                self.decisions.pop()  # replaced by one for more degrees
            degree = band - 1 if gone else degree
            above = f"{band}" if band == base.sh_degree else f"{band} to {base.sh_degree}"
            why = f"change without {'it' if band == base.sh_degree else 'them'}, {_counted(len(views))}"
            self._decide(f"SH degree {above}", "left out" if gone else "kept", why, "bands", loss, "dB")
            tell(self.progress, Phase.SH_DEGREES, base.sh_degree - band + 1, base.sh_degree)
        return degree

    def _errors(self, few: Gaussians) -> _Errors | None:
        """The removal errors; None if they are not needed."""
        if self._kept_unmeasured():
            return None
        fold = spread(self.views, min(VIEWS, len(self.views) // 4))
        views = spread([view for view in self.views if view not in fold], MOST_VIEWS - len(fold))
        every = [*self.views, *(view for view in self.watched if view not in self.views)]
        others = [] if self.placed else [view for view in every if view not in views and view not in fold]
        seed = self.config.seed
        done = (0, len(views), len(views) + len(fold))
        told = [within(self.progress, k, len(every)) for k in done]
        with self._time("start"):
            elsewhere = removal_error(few, views, seed=seed, progress=told[0])
            here = removal_error(few, fold, seed=seed, progress=told[1])
            error = (elsewhere * len(views) + here * len(fold)) / done[2]
        with self._time("unseen"):
            shown = seen(few, others, error, seed, told[2])
        if self.placed:  # a Gaussian that no placed camera shows is as important as others of its opacity and size
            error, elsewhere = (supposed_error(few, found, shown) for found in (error, elsewhere))
        return _Errors(error, shown, elsewhere, fold or views[:VIEWS], len(every))

    def _unseen(self, errors: _Errors | None) -> Tensor | None:
        """The rows to train."""
        if errors is None:
            self._decide("unseen Gaussians", "kept", self._kept_unmeasured(), "unseen")
            return None
        gone = len(errors.seen) - int(errors.seen.sum())
        why = f"of {len(errors.seen):,} change no pixel of {_counted(errors.views)}"
        if self.placed:
            self._decide("unseen Gaussians", "kept", f"{why}, which do not show everything", "unseen", float(gone))
            return None
        if gone == len(errors.seen):  # an invisible checkpoint: no row can be preferred
            gone = 0
        self._decide("unseen Gaussians", "left out" if gone else "kept", why, "unseen" if gone else "", float(gone))
        return errors.seen if gone else None

    def _kept_unmeasured(self) -> str:
        """Why unseen Gaussians are kept without a measurement; empty if they are measured."""
        if "unseen" in self.override.keep:
            return REQUESTED
        if "unseen" in self.override.leave_out:
            return ""
        if has_dial(self.base):
            return "not measured: its dial shows other Gaussians at other dial values"
        if not form_of(self.config).measured:
            return "not measured: in the paper's form every Gaussian begins with the same sigma_d"
        return ""

    def _share(self, few: Gaussians, errors: _Errors | None) -> AdaptConfig:
        """The settings with the share of Gaussians to keep at s = 1."""
        if self.config.start_share is not None or errors is None or self.config.max_sv == 1:
            return self.config
        with self._time("share"):
            share, loss = needed_share(few, errors.fold, errors.elsewhere, SHARE_LIMIT)
        why = f"lost in {_counted(len(errors.fold))} without those that matter least in the others, untrained"
        self._decide(f"{share:.0%} of the Gaussians at s = 1", "kept", why, "", loss, "dB")
        return replace(self.config, start_share=share)

    def _freeze(self, config: AdaptConfig) -> AdaptConfig:
        """The settings with learning rate 0 for the attributes to freeze."""
        frozen = [name for name in RATES if name in self.override.leave_out]
        for name in frozen:
            self._decide(name, "frozen", REQUESTED, name)
        rates: dict[str, Any] = {RATES[name]: 0.0 for name in frozen}
        return replace(config, **rates)

    def _decide(
        self, what: str, verdict: str, why: str, name: str = "", number: float | None = None, unit: str = ""
    ) -> None:
        self.decisions.append(Decision(what, verdict, number, unit, why, name))

    @contextmanager
    def _time(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began


def supposed_error(gaussians: Gaussians, error: Tensor, shown: Tensor) -> Tensor:
    """``[N]`` the removal error, where none is shown that of a shown one of equal ``opacity^2 * area``, in the median.

    Args:
        error: ``[N]`` from ``removal_error``; shown: ``[N]`` bool.
    """
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
    pictures = [render(base.without_bands(used), view.camera).image for view in views] if used else []
    with_all = [psnr(image, view.image) for image, view in zip(pictures, views, strict=True)] if used else []
    for degree in range(used, 0, -1):
        less = base.without_bands(degree - 1)
        without = [psnr(render(less, view.camera).image, view.image) for view in views]
        change = fmean(abs(psnr_change(a, b)) for a, b in zip(with_all, without, strict=True))
        yield degree, change
        if not change < limit:
            return


def seen(base: Gaussians, others: Sequence[View], error: Tensor, seed: int, progress: Listener | None = None) -> Tensor:
    """``[N]`` bool, which Gaussians change any pixel of any of the views that ``error`` is from, and of the others.

    An image is linear in each opacity, so removing a Gaussian changes nothing if no pixel has a derivative by its
    opacity. The backward pass of ``removal_error`` sums the derivatives with random signs; that all of them cancel to
    exactly 0 is not relevant in practice, and ``largest_change`` bounds the effect. Rasterizers clamp alpha, where it
    has no derivative: Gaussians that opaque count as seen.

    Args:
        error: ``[N]`` from ``removal_error``.
        seed: of the signs.
        progress: called in ``Phase.IMPORTANCE`` after each of the other views.
    """
    moves = (error > 0) | (removal_error(base, others, seed=seed, progress=progress) > 0)
    return moves | (base.opacities > ALPHA_MAX)


@torch.no_grad()
def needed_share(base: Gaussians, views: Sequence[View], error: Tensor, limit: float) -> tuple[float, float]:
    """The smallest share of the Gaussians that loses less than ``limit`` dB, in hundredths, and that loss.

    In (0.5, 1], by bisection. The Gaussians with the largest removal error remain, unattenuated. The loss is
    ``gate.decibels_below`` the base.

    Args:
        error: ``[N]`` from ``removal_error``.
    """
    order, opacities = error.argsort(descending=True, stable=True), base.opacities
    whole = [_squared_error(base, opacities, view) for view in views]

    def loss(percent: int) -> float:
        less = opacities.clone()
        less[order[max(round(percent / 100 * len(base)), 1) :]] = 0  # neither sorted nor drawn; a copy is large
        return decibels_below([_squared_error(base, less, view) for view in views], whole)

    low, high, found = 50, 100, 0.0
    while high - low > 1:
        middle = (low + high) // 2
        lost = loss(middle)
        low, high, found = (low, middle, lost) if lost < limit else (middle, high, found)
    return high / 100, found


def _squared_error(gaussians: Gaussians, opacities: Tensor, view: View) -> float:
    return squared_error(splat(gaussians, opacities, view.camera)[0], view)
