"""Making a plan: what a scene does not need is measured before training."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from torch import Tensor

from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, has_dial, initialize, removal_error, spread, usable_views
from clod_adapter.training.ablation import band_losses, effect, seen
from clod_adapter.training.loop import adapt
from clod_adapter.training.plan import FIELDS, RATES, Decision, Override, Plan, freezing
from clod_adapter.training.state import Progress, TrainingState

LIMIT = 0.02  # dB: what is left out is worth less than this to the training views
VIEWS = 8  # training views on which that is measured, evenly spread
PROBE = 30  # steps of the training after which attributes are judged; it then goes on from there
SHARE = 0.1  # of the training that these may be, by steps and by time budget; else nothing is judged


def make_plan(
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig | None = None,
    overrule: Override | None = None,
    progress: Callable[[Progress], None] | None = None,
    *,
    resumed: Collection[str] | None = None,
) -> Plan:
    """Looks at what ``base`` needs on the training views of ``scene``, and makes the start that training begins from.

    The same Gaussians, views and settings give the same plan.

    Args:
        overrule: what is settled; for that nothing is measured, but which Gaussians are unseen.
        progress: called in the phases "bands", "start", "order" and "probe".
        resumed: of a training that goes on from a state, the attributes that it froze (``Plan.frozen``).

    Raises:
        ClodError: as ``train.adapt``.
        KeyboardInterrupt: ``progress`` raised one.
    """
    return _Planner(base, scene, config or AdaptConfig(), overrule or Override(), progress).plan(resumed)


class _Planner:
    """Makes one plan."""

    def __init__(
        self, base: Gaussians, scene: Scene, config: AdaptConfig, overrule: Override,
        progress: Callable[[Progress], None] | None,
    ) -> None:  # fmt: skip
        self.base, self.scene, self.config, self.overrule, self.progress = base, scene, config, overrule, progress
        if not scene.train or not len(base):
            adapt(base, scene, config)  # refuses, and says why
        self.views = usable_views(base, scene.train)
        self.decisions: list[Decision] = []
        self.seconds: dict[str, float] = {}
        self.began = time.perf_counter()

    def plan(self, resumed: Collection[str] | None) -> Plan:
        with self._time("bands"):
            degree = self._bands()
        few = self.base.without_bands(degree)
        kept, error = self._unseen(few)
        with self._time("start"):
            begun = initialize(few, self.views, self.config, self._report, error=error)
        plan = Plan((), begun, kept, degree, self.config)
        with self._time("probe"):
            plan = self._attributes(plan, resumed)
        self.seconds["probe"] -= sum(state.seconds for state in plan.begun)  # which are steps of the training
        left_out = tuple(Decision(what, "left out", None, "", why) for what, why in self.scene.left_out)
        return replace(plan, decisions=(*self.decisions, *left_out), seconds=self.seconds)

    def _bands(self) -> int:
        """The SH degree to train with."""
        base, views = self.base, spread(self.views, VIEWS)
        degree = base.sh_degree
        if degree == 0 or "bands" in self.overrule.keep:
            self._settled("SH bands", "bands" if degree else "", degree > 0)
            return degree
        if "bands" in self.overrule.leave_out:
            self._settled("SH bands", "bands", False)
            return 0
        for band, loss in band_losses(base, views, LIMIT):
            gone = loss < LIMIT
            if gone and degree < base.sh_degree:
                self.decisions.pop()  # of fewer of them
            degree = band - 1 if gone else degree
            above = f"{band}" if band == base.sh_degree else f"{band} to {base.sh_degree}"
            why = f"change without {'it' if band == base.sh_degree else 'them'}, {_counted(len(views))}"
            self._decide(f"SH band {above}", "left out" if gone else "kept", loss, "dB", why, "bands")
            self._report("bands", base.sh_degree - band + 1, base.sh_degree)
        return degree

    def _unseen(self, few: Gaussians) -> tuple[Tensor | None, Tensor | None]:
        """The rows to train, and the removal error where that has come of it."""
        if "unseen" in self.overrule.keep:
            self._settled("unseen Gaussians", "unseen", True)
            return None, None
        if (why := self._others_show()) and "unseen" not in self.overrule.leave_out:
            self._decide("unseen Gaussians", "kept", None, "", f"not looked for: {why}", "unseen")
            return None, None
        views, seed = spread(self.views, MOST_VIEWS), self.config.seed
        with self._time("start"):
            error = removal_error(few, views, seed=seed, progress=lambda done, _: self._look(done))
        with self._time("unseen"):
            kept = seen(few, self.views, error, seed, lambda done, _: self._look(len(views) + done))
        gone = len(few) - int(kept.sum())
        of = f"of {len(few):,} move no pixel of {_counted(len(self.views))}"
        if gone == len(few):  # a checkpoint that shows nothing; nothing says which rows it needs
            gone = 0
        self._decide("unseen Gaussians", "left out" if gone else "kept", float(gone), "", of, "unseen" if gone else "")
        return kept if gone else None, error

    def _others_show(self) -> str:
        """Why Gaussians that no view sees at s = 1 may show at another dial value untrained; empty where none does."""
        if has_dial(self.base):
            return "with the dial that it has other ones show"
        if self.config.start in ("constant", "identity"):
            return f"from a start that is {self.config.start} they never leave"
        return ""

    def _attributes(self, plan: Plan, resumed: Collection[str] | None) -> Plan:
        """Freezes what can do too little, and does the first steps of the training to find out."""
        keep, frozen = self.overrule.keep, set(self.overrule.leave_out) & set(RATES)
        ours = [name for name in RATES if getattr(self.config, RATES[name]) > 0]  # others are frozen by the settings
        undecided = [name for name in ours if name not in keep | frozen]
        for name in ours:
            if name not in undecided:
                self._settled(name, name, name in keep, ("trained", "frozen"))
        plan = replace(plan, config=freezing(self.config, frozen))
        if resumed is not None:
            for name in undecided:
                self._decide(name, "frozen" if name in resumed else "trained", None, "", "as before the interruption")
            return replace(plan, config=freezing(plan.config, set(undecided) & set(resumed)))
        if not undecided or self.config.iters * SHARE < PROBE:
            self._leave(undecided)
            return plan
        probe, state = self._probe(plan)
        if state.steps < PROBE:  # the time budget is short
            self._leave(undecided)
            return replace(plan, begun=[state])
        useless = {name for name in undecided if self._does_too_little(name, plan.lean, probe)}
        return replace(plan, config=freezing(plan.config, useless)) if useless else replace(plan, begun=[state])

    def _leave(self, undecided: Sequence[str]) -> None:
        """Attributes that are trained, as the training is too short to find out."""
        why = f"not judged: {PROBE} steps are much of so short a training"
        for name in undecided:
            self._decide(name, "trained", None, "", why, name)

    def _does_too_little(self, name: str, before: Gaussians, after: Gaussians) -> bool:
        """Decides on one attribute, by its move in the first steps.

        What a move does grows by less than the root of the steps (docs/plan.md), which bounds it for the end.
        """
        dials = sorted({1.0, math.sqrt(self.config.max_sv), self.config.max_sv}, reverse=True)
        views, longer = spread(self.views, VIEWS // 2), math.sqrt(self.config.iters / PROBE)
        most, s = effect(FIELDS.get(name, name), before, after, views, dials, LIMIT / longer)
        gone = most < LIMIT / longer
        why = f"change by its first {PROBE} steps, at s = {s:.3g}; frozen below {LIMIT / longer:.2g}"
        self._decide(name, "frozen" if gone else "trained", most, "dB", why, name)
        return gone

    def _probe(self, plan: Plan) -> tuple[Gaussians, TrainingState]:
        """The first steps of the training, after which it stops: PROBE of them, those of SHARE of a time budget, or
        those before one that fails, which the training then comes to.
        """
        found: list[tuple[Gaussians, TrainingState]] = []

        def follow(now: Progress) -> None:
            if now.phase == "train":
                self._report("probe", now.done, PROBE)
                if now.state is not None and (now.done == PROBE or now.share >= SHARE or now.lost):
                    found.append((now.gaussians(), now.state()))
                    raise KeyboardInterrupt

        plan.adapt(self.scene, follow)
        if not found:  # stopped by whoever follows
            raise KeyboardInterrupt
        return found[0]

    def _decide(self, *of: Any) -> None:
        self.decisions.append(Decision(*of))

    def _settled(self, what: str, name: str, kept: bool, words: tuple[str, str] = ("kept", "left out")) -> None:
        why = "as asked, whatever it is worth" if name else "there are none"
        self._decide(what, words[0] if kept else words[1], None, "", why, name)

    def _look(self, done: int) -> None:
        """At so many of the views, to find out what each Gaussian does in them."""
        self._report("start", done, len(self.views))

    def _report(self, phase: str, done: int, total: int) -> None:
        if self.progress:
            seconds = time.perf_counter() - self.began
            self.progress(Progress(phase, done, total, seconds, done / total, math.nan, lambda: self.base))

    @contextmanager
    def _time(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began


def _counted(views: int) -> str:
    return f"{views:,} training view{'s' if views > 1 else ''}"
