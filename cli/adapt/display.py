"""Progress of planning and training on the console, with the held-out error so far."""

from __future__ import annotations

import math
import time
from statistics import fmean

import torch

from clod_adapter.cameras import View
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import psnr
from clod_adapter.progress import Phase, Progress
from clod_adapter.render import render

from ..shared.console import Console, Meter
from ..shared.process import GracefulStop

CHECK_EVERY = 10.0  # seconds between measurements on held-out views, at least
CHECK_COST = 0.03  # largest share of the time that they may take
CHECK_VIEWS = 4


class ProgressDisplay:
    """A listener that shows progress, and stops on Ctrl-C.

    Args:
        base: the PSNR so far at dial value 1 is shown against its PSNR; None if its own renders are the views.
        views: held out; at most four of them, evenly spread, are measured.
        base_row: the base's row, for an estimate of the time of a frame.
        training: the label of ``Phase.TRAINING``.
    """

    def __init__(
        self,
        console: Console,
        stop: GracefulStop,
        base: Gaussians | None,
        views: tuple[View, ...],
        base_row: Row | None,
        training: str = Phase.TRAINING,
    ) -> None:
        self.console, self.stop, self.training = console, stop, training
        self.views = views[:: -(-len(views) // CHECK_VIEWS)] if views else ()
        seconds_a_frame = base_row.frame_ms / 1e3 if base_row else 0.0
        self.check_due, self.check_cost = CHECK_EVERY, seconds_a_frame * len(self.views)
        self.base, self.base_error, self.error = base, math.nan, ""
        self.phase: Phase | None = None
        self.meter: Meter | None = None

    def __call__(self, progress: Progress) -> bool:
        if self.meter is None or progress.phase != self.phase:
            self.close()
            before = progress.share if progress.done > 1 else 0.0  # a resumed training's
            self.phase, label = progress.phase, self.training if progress.phase == Phase.TRAINING else progress.phase
            self.meter = Meter(self.console, label, initial=before)
        training = progress.phase == Phase.TRAINING
        if training and progress.share < 1 and not self.stop.requests:
            self._check(progress)
        by_time = progress.share > progress.done / max(progress.total, 1)
        steps = f"step {progress.done}" if by_time else f"{progress.done}/{progress.total}"
        self.meter.update(progress.share, (self.error if training else "") or steps)
        if not progress.error and not self.stop.requests:
            return True
        self.close()
        if training and not progress.error:
            again = " (Ctrl-C again aborts without writing)" if self.stop.aborts and self.stop.presses else ""
            self.console.say(f"stopping{again}")
        return False

    def close(self) -> None:
        if self.meter is not None:
            self.meter.close()

    @torch.no_grad()
    def _check(self, progress: Progress) -> None:
        """Measures the error on the held-out views now and then."""
        if self.console.quiet or not self.views or progress.seconds < self.check_due:
            return
        if self.check_cost > CHECK_COST * progress.seconds / progress.share:
            return  # even one measurement is too many for so short a run
        began = time.perf_counter()
        if self.base is not None and math.isnan(self.base_error):
            self.base_error = self._measure(self.base)  # of the same views
        assert progress.gaussians is not None
        self.error = self._text(self._measure(progress.gaussians()))
        self.check_cost = time.perf_counter() - began
        self.check_due = progress.seconds + max(CHECK_EVERY, self.check_cost / CHECK_COST)

    def _text(self, found: float) -> str:
        if self.base is None:
            return f"{found:.2f} dB at s=1"
        gain = found - self.base_error
        return f"{abs(gain):.2f} dB {'below' if gain < 0 else 'above'} the base at s=1"

    def _measure(self, gaussians: Gaussians) -> float:
        """PSNR at full quality, mean over the views, dB."""
        return fmean(psnr(render(gaussians, view.camera, 1.0).image, view.image) for view in self.views)
