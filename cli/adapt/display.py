"""Progress of planning and training on the console, with the held-out error so far."""

from __future__ import annotations

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
from ..shared.interrupts import GracefulStop

CHECK_EVERY = 10.0  # seconds between measurements on held-out views, at least
CHECK_COST = 0.03  # largest share of the time that they may take
CHECK_VIEWS = 4


class ProgressDisplay:
    """A listener that shows progress, and stops on Ctrl-C.

    Args:
        base: the error so far is compared with its error; None without views.
        views: held out; at most four of them, evenly spread, are measured.
        max_sv: the error is shown at dial value 1 and here.
        base_row: the base's row: the error shown first, and an estimate of the time of a frame.
        training: the label of ``Phase.TRAINING``.
    """

    def __init__(
        self,
        console: Console,
        stop: GracefulStop,
        base: Gaussians | None,
        views: tuple[View, ...],
        max_sv: float,
        base_row: Row | None,
        training: str = Phase.TRAINING,
    ) -> None:
        self.console, self.stop, self.training = console, stop, training
        self.views = views[:: -(-len(views) // CHECK_VIEWS)] if views else ()
        self.dials = [1.0, max_sv] if max_sv > 1 else [1.0]
        seconds_a_frame = base_row.frame_ms / 1e3 if base_row else 0.0
        self.check_due, self.check_cost = CHECK_EVERY, seconds_a_frame * len(self.views) * len(self.dials)
        self.error = f"base {base_row.psnr:.2f} dB" if base_row else ""
        self.base, self.base_error = base, ""
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
        error = self.error if training else ""
        self.meter.update(progress.share, f"{steps}, {error}".removesuffix(", "))
        if not progress.error and not self.stop.requests:
            return True
        self.close()
        if training and not progress.error:
            again = " (Ctrl-C again aborts without writing)" if self.stop.aborts else ""
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
        if not self.base_error and self.base is not None:  # of the same views
            self.base_error = f"base {self._measure(self.base, 1.0)[0]:.2f} dB on these {len(self.views)} views"
        assert progress.gaussians is not None
        measured = [(dial, *self._measure(progress.gaussians(), dial)) for dial in self.dials]
        shown = [f"s={dial:g} {error:.2f} dB {share:.0%}" for dial, error, share in measured]
        self.error = ", ".join([*shown, self.base_error])
        self.check_cost = time.perf_counter() - began
        self.check_due = progress.seconds + max(CHECK_EVERY, self.check_cost / CHECK_COST)

    def _measure(self, gaussians: Gaussians, dial: float) -> tuple[float, float]:
        """PSNR and share kept, means over the views."""
        pictures = [render(gaussians, view.camera, dial) for view in self.views]
        error = fmean(psnr(picture.image, view.image) for picture, view in zip(pictures, self.views, strict=True))
        return error, fmean(float(picture.kept.float().mean()) for picture in pictures)
