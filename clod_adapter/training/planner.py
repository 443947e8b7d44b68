"""Making a plan: before training, measures what the scene does not need."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from torch import Tensor

from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, has_dial, initialize, removal_error, spread, usable_views
from clod_adapter.progress import Listener, Phase, tell, within
from clod_adapter.training.ablation import needed_share, seen, sh_degree_losses
from clod_adapter.training.loop import require_trainable
from clod_adapter.training.plan import NOT_NEEDED, RATES, Decision, Override, Plan

SHARE_LIMIT = 0.01  # dB: the share kept at s = 1 loses less on these views
LIMIT = 0.02  # dB: SH degrees and Gaussians are left out if the PSNR of the training views changes by less without them
VIEWS = 8  # evenly spread training views on which that is measured
REQUESTED = "as requested, not measured"


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


class _Planner:
    """Makes one plan."""

    def __init__(
        self, base: Gaussians, scene: Scene, config: AdaptConfig, override: Override, progress: Listener | None
    ) -> None:
        self.base, self.scene, self.config, self.override, self.progress = base, scene, config, override, progress
        require_trainable(base, scene, config)
        self.views = usable_views(base, scene.train)
        self.decisions: list[Decision] = []
        self.seconds: dict[str, float] = {}

    def plan(self) -> Plan:
        with self._time("bands"):
            degree = self._sh_degree()
        few = self.base.without_bands(degree)
        kept, error = self._unseen(few)
        config = self._share(few, error)
        with self._time("start"):
            initial = initialize(few, self.views, config, self.progress, error=error)
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

    def _unseen(self, few: Gaussians) -> tuple[Tensor | None, Tensor | None]:
        """The rows to train, and the removal error if it was computed on the way."""
        if reason := self._kept_unmeasured():
            self._decide("unseen Gaussians", "kept", reason, "unseen")
            return None, None
        views, seed = spread(self.views, MOST_VIEWS), self.config.seed
        with self._time("start"):
            error = removal_error(few, views, seed=seed, progress=within(self.progress, 0, len(self.views)))
        with self._time("unseen"):
            kept = seen(few, self.views, error, seed, within(self.progress, len(views), len(self.views)))
        gone = len(few) - int(kept.sum())
        why = f"of {len(few):,} change no pixel of {_counted(len(self.views))}"
        if gone == len(few):  # an invisible checkpoint: no row can be preferred
            gone = 0
        self._decide("unseen Gaussians", "left out" if gone else "kept", why, "unseen" if gone else "", float(gone))
        return kept if gone else None, error

    def _kept_unmeasured(self) -> str:
        """Why unseen Gaussians are kept without a measurement; empty if they are measured."""
        if "unseen" in self.override.keep:
            return REQUESTED
        if "unseen" in self.override.leave_out:
            return ""
        if has_dial(self.base):
            return "not measured: its dial shows other Gaussians at other dial values"
        if self.config.start in ("constant", "identity"):
            return f"not measured: with a {self.config.start} initialization none is culled at any dial value"
        return ""

    def _share(self, few: Gaussians, error: Tensor | None) -> AdaptConfig:
        """The settings with the share of Gaussians to keep at s = 1."""
        if self.config.start_share is not None or error is None or self.config.max_sv == 1:
            return self.config
        with self._time("share"):
            views = spread(self.views, VIEWS)
            share, loss = needed_share(few, views, error, SHARE_LIMIT)
        why = f"lost without the other {1 - share:.0%}, untrained, {_counted(len(views))}"
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


def _counted(views: int) -> str:
    return f"{views:,} training view{'s' if views > 1 else ''}"
