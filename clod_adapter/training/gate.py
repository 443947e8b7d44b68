"""The gate: watches full quality on views that are not trained on, and undoes training that harms it."""

import math
from collections.abc import Sequence
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.cameras import View
from clod_adapter.losses import psnr
from clod_adapter.training.pseudo_views import PseudoView
from clod_adapter.training.state import Watched

FEW, EVERY, MOST = 8, 24, 4  # of fewer than FEW views all are watched and trained on; else one of EVERY, 2 to MOST
WORSE, RUINED = 1.0, 4.0  # dB that s = 1 may fall below its best, until the next check, and at all
SETTLED = 0.7  # share of the training before which only RUINED counts: what large steps cost, smaller ones regain
HALVINGS = 3  # of the learning rates; the next time the attributes are frozen
CHECKS = (0.0, 0.02, 0.05, *(k / 10 for k in range(1, 10)))  # of the steps or the time budget
EXACT = 1e-12  # mean squared error that none is taken for: its logarithm is finite
ERROR_FLOOR = 1e-3  # mean squared error of a render at 30 dB


def split_views(views: Sequence[View]) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Views to train on, and views to watch: the right halves of a few, whose left halves are trained on.

    Without 7 of 84 whole photographs s = 1 loses 0.15 dB on plush_half. Of pseudo views, which cost nothing, whole ones
    are watched; of few views all are trained on, and watched.
    """
    if len(views) < FEW:
        return tuple(views), tuple(views)
    count, trained, watched = min(max(len(views) // EVERY, 2), MOST), list[View](), list[View]()
    numbers = {(2 * k + 1) * len(views) // (2 * count) for k in range(count)}
    for k, view in enumerate(views):
        if k not in numbers:
            trained.append(view)
        elif isinstance(view, PseudoView):
            watched.append(view)
        else:
            middle = view.camera.width // 2
            trained.append(view.columns(0, middle))
            watched.append(view.columns(middle, view.camera.width))
    return tuple(trained), tuple(watched)


def decibels_below(errors: Sequence[float], base: Sequence[float]) -> float:
    """``mean 10 log10(e / b)`` over views, of mean squared errors e and the base's b, which is at least ERROR_FLOOR.

    Against its own renderings a checkpoint has no error, and every difference would be infinite.
    """
    pairs = [(e, b, max(ERROR_FLOOR - b, 0.0)) for e, b in zip(errors, base, strict=True)]
    return fmean(10 * math.log10(max(e + floor, EXACT) / (b + floor)) for e, b, floor in pairs)


def squared_error(image: Tensor, view: View) -> float:
    """Mean squared error of a render, clamped to [0, 1], against the view's photograph."""
    return 10 ** (-psnr(image, view.image) / 10)


class Gate:
    """Measures s = 1 against the base, from the first steps on, in images of half the size (not small ones).

    If s = 1 is RUINED below its best, or from SETTLED on more than WORSE in two checks, and not recovering, the
    parameters return to the last state that was not, Adam's moments are forgotten, and the learning rates are halved;
    after HALVINGS of these the attributes are frozen. A return to an early state costs the far end of the dial half a
    decibel, so what large steps at first cost is no reason for one.
    """

    def __init__(self, trainer: Any, views: Sequence[View], trained_on: bool) -> None:  # training.trainer.Trainer
        self.trainer, self.views, self.trained_on = trainer, views, trained_on
        self.base = [self._error(view, None) for view in views]
        # The last state that passed; the best loss (``decibels_below``), rollbacks so far, CHECKS made, the last loss.
        self.good = {name: value.clone() for name, value in trainer.trained().items()}
        self.numbers = torch.tensor([math.inf, 0.0, 0.0, 0.0], dtype=torch.float64)

    @property
    def rollbacks(self) -> int:
        return int(self.numbers[1])

    def check(self, share_done: float) -> None:
        """Checks the parameters if it is time to."""
        made = int(self.numbers[2])
        if made >= len(CHECKS) or share_done < CHECKS[made]:
            return
        self.numbers[2] = sum(share_done >= due for due in CHECKS)
        loss = self._loss(self.trainer.parameters)
        best, last, self.numbers[3] = float(self.numbers[0]), float(self.numbers[3]), loss
        if loss <= best + WORSE:
            self.numbers[0] = min(best, loss)
            for name, value in self.trainer.trained().items():
                self.good[name].copy_(value)
        elif not loss <= best + RUINED or (share_done >= SETTLED and best + WORSE < last <= loss):  # or NaN
            self.numbers[1] += 1
            self.numbers[3] = best
            self.trainer.return_to(self.good)

    def finish(self) -> Watched:
        """Checks the result; one that is too bad is replaced by the last good state."""
        loss = self._loss(self.trainer.parameters | self.trainer.averages())
        if not loss <= self.numbers[0] + WORSE:
            self.numbers[1] += 1
            self.trainer.return_to(self.good)
            loss = self._loss(self.trainer.parameters)
        return Watched(len(self.views), self.trained_on, loss, self.rollbacks, self.rollbacks > HALVINGS)

    def weaken(self, rates: dict[str, float]) -> dict[str, float]:
        """The learning rates after the rollbacks so far."""
        frozen = set(ATTRIBUTES) if self.rollbacks > HALVINGS else set()
        return {name: 0.0 if name in frozen else rate * 0.5**self.rollbacks for name, rate in rates.items()}

    def _loss(self, parameters: dict[str, Tensor]) -> float:
        """``decibels_below`` the base of these parameters at s = 1; in a group the first process's."""
        group = self.trainer.group
        found = math.nan
        if group is None or group.rank == 0:
            found = decibels_below([self._error(view, parameters) for view in self.views], self.base)
        return group.broadcast(found) if group else found

    @torch.no_grad()
    def _error(self, view: View, parameters: dict[str, Tensor] | None) -> float:
        """Of s = 1 of the parameters, or of the base without a dial."""
        small = view.camera.halvable
        view = view.halved() if small else view
        return squared_error(self.trainer.image(parameters, view.camera, small), view)
