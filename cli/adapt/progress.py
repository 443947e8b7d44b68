"""Training as the user follows it: progress, and the held-out error so far."""

from __future__ import annotations

import time
from statistics import fmean

import torch

from clod_adapter.cameras import View
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import psnr
from clod_adapter.render import render
from clod_adapter.training.loop import Progress

from ..shared.console import Console, Meter
from ..shared.interrupts import GracefulStop

CHECK_EVERY = 10.0  # seconds between looks at the held-out views, at least
CHECK_COST = 0.03  # share of the time that they may take, at most
CHECK_VIEWS = 4
LABELS = {
    "bands": "SH bands", "start": "importance", "order": "order of leaving", "probe": "first steps",
    "blocks": "what views see", "beside": "what is beside", "targets": "pictures to be",
    "quotas": "how many to keep", "train": "training",
}  # fmt: skip


class ProgressDisplay:
    """The progress callback of ``adapt``.

    Args:
        base: what the error so far is compared with; None where there are no views.
        views: held out; at most four of them, spread evenly, are looked at.
        max_sv: the error is shown at dial 1 and here.
        base_row: how the base was measured: the error shown until there is a newer one, and a guess of a frame's time.
    """

    def __init__(
        self,
        console: Console,
        stop: GracefulStop,
        base: Gaussians | None,
        views: tuple[View, ...],
        max_sv: float,
        base_row: Row | None,
    ) -> None:
        self.console, self.stop, self.labels = console, stop, LABELS
        self.views = views[:: -(-len(views) // CHECK_VIEWS)] if views else ()
        self.dials = [1.0, max_sv] if max_sv > 1 else [1.0]
        seconds_a_frame = base_row.frame_ms / 1e3 if base_row else 0.0
        self.check_due, self.check_cost = CHECK_EVERY, seconds_a_frame * len(self.views) * len(self.dials)
        self.error = f"base {base_row.psnr:.2f} dB" if base_row else ""
        self.base, self.base_error = base, ""
        self.phase = ""
        self.meter: Meter | None = None

    def __call__(self, progress: Progress) -> None:
        if self.meter is None or progress.phase != self.phase:
            self.close()
            before = progress.share if progress.done > 1 else 0.0  # a resumed training's
            self.phase, self.meter = progress.phase, Meter(self.console, self.labels[progress.phase], initial=before)
        if progress.phase == "train" and progress.share < 1 and not self.stop.requests:
            self._check(progress)
        by_time = progress.share > progress.done / max(progress.total, 1)
        steps = f"step {progress.done}" if by_time else f"{progress.done}/{progress.total}"
        error = self.error if progress.phase == "train" else ""
        self.meter.update(progress.share, f"{steps}, {error}".removesuffix(", "))
        if progress.lost:
            self.close()
            raise KeyboardInterrupt  # with which its state is saved
        if self.stop.requests:
            self.close()
            if self.phase == "train":
                again = " (Ctrl-C again aborts without writing)" if self.stop.aborts else ""
                self.console.say(f"stopping{again}")
            raise KeyboardInterrupt

    def close(self) -> None:
        if self.meter is not None:
            self.meter.close()

    @torch.no_grad()
    def _check(self, progress: Progress) -> None:
        """Now and then, the error on the held-out views."""
        if self.console.quiet or not self.views or progress.seconds < self.check_due:
            return
        if self.check_cost > CHECK_COST * progress.seconds / progress.share:
            return  # even one look would be too many for so short a run
        began = time.perf_counter()
        if not self.base_error and self.base is not None:  # of the same views: some are harder than others
            self.base_error = f"base {self._look(self.base, 1.0)[0]:.2f} dB on these {len(self.views)} views"
        looks = [(dial, *self._look(progress.gaussians(), dial)) for dial in self.dials]
        shown = [f"s={dial:g} {error:.2f} dB {share:.0%}" for dial, error, share in looks]
        self.error = ", ".join([*shown, self.base_error])
        self.check_cost = time.perf_counter() - began
        self.check_due = progress.seconds + max(CHECK_EVERY, self.check_cost / CHECK_COST)

    def _look(self, gaussians: Gaussians, dial: float) -> tuple[float, float]:
        """PSNR and share kept, means over the views that are looked at."""
        pictures = [render(gaussians, view.camera, dial) for view in self.views]
        error = fmean(psnr(picture.image, view.image) for picture, view in zip(pictures, self.views, strict=True))
        return error, fmean(float(picture.kept.float().mean()) for picture in pictures)
