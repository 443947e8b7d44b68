"""Making a plan: before training, measures what the scene does not need."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from torch import Tensor

from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, has_dial, initialize, removal_error, spread, usable_views
from clod_adapter.progress import Listener, Phase, Progress, Stopped, tell, within
from clod_adapter.training.ablation import effect, seen, sh_degree_losses
from clod_adapter.training.loop import adapt
from clod_adapter.training.plan import FIELDS, RATES, Decision, Override, Plan, freezing
from clod_adapter.training.state import TrainingState

LIMIT = 0.02  # dB: what is left out changes the PSNR of the training views by less
VIEWS = 8  # evenly spread training views on which that is measured
PROBE = 30  # training steps after which the effect of each attribute is measured; training continues from there
SHARE = 0.1  # largest share of the training, by steps and by time budget, that these steps may be


def make_plan(
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig | None = None,
    override: Override | None = None,
    progress: Listener | None = None,
    *,
    resumed: Collection[str] | None = None,
) -> Plan:
    """Measures what the training views of ``scene`` need of ``base``, and computes the initial sigma_d.

    The same Gaussians, views and settings give the same plan.

    Args:
        override: fixed decisions, which are not measured, except which Gaussians are unseen.
        progress: called in ``Phase.SH_DEGREES``, ``IMPORTANCE``, ``PRUNING_ORDER`` and ``FIRST_STEPS``.
        resumed: when resuming from a state, the attributes that the earlier plan froze (``Plan.frozen``).

    Raises:
        ClodError: as ``loop.adapt``.
        Stopped: ``progress`` returned False, or Ctrl-C ended the first steps.
    """
    return _Planner(base, scene, config or AdaptConfig(), override or Override(), progress).plan(resumed)


class _Planner:
    """Makes one plan."""

    def __init__(
        self, base: Gaussians, scene: Scene, config: AdaptConfig, override: Override, progress: Listener | None
    ) -> None:
        self.base, self.scene, self.config, self.override, self.progress = base, scene, config, override, progress
        if not scene.train or not len(base):
            adapt(base, scene, config)  # raises the ClodError
        self.views = usable_views(base, scene.train)
        self.decisions: list[Decision] = []
        self.seconds: dict[str, float] = {}

    def plan(self, resumed: Collection[str] | None) -> Plan:
        with self._time("bands"):
            degree = self._sh_degree()
        few = self.base.without_bands(degree)
        kept, error = self._unseen(few)
        with self._time("start"):
            begun = initialize(few, self.views, self.config, self.progress, error=error)
        plan = Plan((), begun, kept, degree, self.config)
        with self._time("probe"):
            plan = self._attributes(plan, resumed)
        self.seconds["probe"] -= plan.begun.seconds if plan.begun else 0.0  # counted as training
        left_out = tuple(Decision(what, "left out", None, "", why) for what, why in self.scene.left_out)
        return replace(plan, decisions=(*self.decisions, *left_out), seconds=self.seconds)

    def _sh_degree(self) -> int:
        """The SH degree to train with."""
        base, views = self.base, spread(self.views, VIEWS)
        degree = base.sh_degree
        if degree == 0 or "bands" in self.override.keep:
            self._fixed("SH degrees", "bands" if degree else "", degree > 0)
            return degree
        if "bands" in self.override.leave_out:
            self._fixed("SH degrees", "bands", False)
            return 0
        for band, loss in sh_degree_losses(base, views, LIMIT):
            gone = loss < LIMIT
            if gone and degree < base.sh_degree:
                self.decisions.pop()  # replaced by one for more degrees
            degree = band - 1 if gone else degree
            above = f"{band}" if band == base.sh_degree else f"{band} to {base.sh_degree}"
            why = f"change without {'it' if band == base.sh_degree else 'them'}, {_counted(len(views))}"
            self._decide(f"SH degree {above}", "left out" if gone else "kept", loss, "dB", why, "bands")
            tell(self.progress, Phase.SH_DEGREES, base.sh_degree - band + 1, base.sh_degree)
        return degree

    def _unseen(self, few: Gaussians) -> tuple[Tensor | None, Tensor | None]:
        """The rows to train, and the removal error if it was computed on the way."""
        if "unseen" in self.override.keep:
            self._fixed("unseen Gaussians", "unseen", True)
            return None, None
        if (why := self._others_show()) and "unseen" not in self.override.leave_out:
            self._decide("unseen Gaussians", "kept", None, "", f"not measured: {why}", "unseen")
            return None, None
        views, seed = spread(self.views, MOST_VIEWS), self.config.seed
        with self._time("start"):
            error = removal_error(few, views, seed=seed, progress=within(self.progress, 0, len(self.views)))
        with self._time("unseen"):
            kept = seen(few, self.views, error, seed, within(self.progress, len(views), len(self.views)))
        gone = len(few) - int(kept.sum())
        of = f"of {len(few):,} change no pixel of {_counted(len(self.views))}"
        if gone == len(few):  # an invisible checkpoint: no row can be preferred
            gone = 0
        self._decide("unseen Gaussians", "left out" if gone else "kept", float(gone), "", of, "unseen" if gone else "")
        return kept if gone else None, error

    def _others_show(self) -> str:
        """Why Gaussians that no view sees at s = 1 may be visible at another dial value; empty if none is."""
        if has_dial(self.base):
            return "its dial shows other Gaussians at other dial values"
        if self.config.start in ("constant", "identity"):
            return f"with a {self.config.start} initialization none is culled at any dial value"
        return ""

    def _attributes(self, plan: Plan, resumed: Collection[str] | None) -> Plan:
        """Freezes attributes whose training has too little effect, as measured by the first training steps."""
        keep, frozen = self.override.keep, set(self.override.leave_out) & set(RATES)
        ours = [name for name in RATES if getattr(self.config, RATES[name]) > 0]  # the settings freeze the others
        undecided = [name for name in ours if name not in keep | frozen]
        for name in ours:
            if name not in undecided:
                self._fixed(name, name, name in keep, ("trained", "frozen"))
        plan = replace(plan, config=freezing(self.config, frozen))
        if resumed is not None:
            for name in undecided:
                self._decide(name, "frozen" if name in resumed else "trained", None, "", "as in the resumed run")
            return replace(plan, config=freezing(plan.config, set(undecided) & set(resumed)))
        if not undecided or self.config.iters * SHARE < PROBE:
            self._train(undecided)
            return plan
        probe, state = self._probe(plan)
        if state.steps < PROBE:  # the time budget is short
            self._train(undecided)
            return replace(plan, begun=state)
        useless = {name for name in undecided if self._does_too_little(name, plan.lean, probe)}
        return replace(plan, config=freezing(plan.config, useless)) if useless else replace(plan, begun=state)

    def _train(self, undecided: Sequence[str]) -> None:
        """Decides to train attributes whose effect is not measured."""
        why = f"not measured: the training is too short for {PROBE} test steps"
        for name in undecided:
            self._decide(name, "trained", None, "", why, name)

    def _does_too_little(self, name: str, before: Gaussians, after: Gaussians) -> bool:
        """Decides on one attribute by the effect of its change in the first steps.

        The effect grows by less than the square root of the steps (docs/plan.md), which bounds it at the end.
        """
        dials = sorted({1.0, math.sqrt(self.config.max_sv), self.config.max_sv}, reverse=True)
        views, longer = spread(self.views, VIEWS // 2), math.sqrt(self.config.iters / PROBE)
        most, s = effect(FIELDS.get(name, name), before, after, views, dials, LIMIT / longer)
        gone = most < LIMIT / longer
        why = f"change by its first {PROBE} steps, at s = {s:.3g}; frozen below {LIMIT / longer:.2g}"
        self._decide(name, "frozen" if gone else "trained", most, "dB", why, name)
        return gone

    def _probe(self, plan: Plan) -> tuple[Gaussians, TrainingState]:
        """The first training steps: PROBE, those of SHARE of the time budget, or those before one that fails."""
        last: list[Progress] = []

        def listen(now: Progress) -> bool:
            last[:] = [now]
            try:
                tell(self.progress, Phase.FIRST_STEPS, now.done, PROBE)
            except Stopped:
                last.clear()
            return bool(last) and now.done < PROBE and now.share < SHARE

        adapted = plan.adapt(self.scene, listen)
        if not last or adapted.signalled:
            raise Stopped(f"stopped at test step {adapted.steps}")
        gaussians, state = last[0].gaussians, last[0].state
        assert gaussians is not None and state is not None
        return gaussians(), state()

    def _decide(self, *of: Any) -> None:
        self.decisions.append(Decision(*of))

    def _fixed(self, what: str, name: str, kept: bool, words: tuple[str, str] = ("kept", "left out")) -> None:
        why = "as requested, not measured" if name else "there are none"
        self._decide(what, words[0] if kept else words[1], None, "", why, name)

    @contextmanager
    def _time(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began


def _counted(views: int) -> str:
    return f"{views:,} training view{'s' if views > 1 else ''}"
