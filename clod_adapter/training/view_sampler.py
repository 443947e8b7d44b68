"""Sampling of the training views and of the dial values that they are rendered at."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.pseudo_views import PseudoView
from clod_adapter.training.state import OTHER_RUN

RENDERED, COUNTED = 1.25, 1.5  # times max_sv: the largest dial values of steps, and of counts
UNATTENUATED = 0.25  # of the steps at s = 1: at s = 0 instead, where every Gaussian is as it is stored
GOLDEN = (5**0.5 - 1) / 2


class Sample(NamedTuple):
    """What one step does with one view.

    Attributes:
        view: camera and photograph.
        dial: the dial value that it is rendered at.
        counted: a dial value that Gaussians are only counted at; None if there is no target-count curve.
        halved: whether the view has half its size.
    """

    view: View
    dial: float
    counted: float | None = None
    halved: bool = False


class ViewSampler:
    """Samples views and dial values from ``config.seed``; the same in every process.

    Args:
        tau: the culling threshold at s = 1, where it is not the config's.

    Attributes:
        order: the numbers of the remaining views of this round, the next one last.
        offset: of the sequence of dial values.
    """

    def __init__(self, views: tuple[View, ...], config: AdaptConfig, tau: float | None = None) -> None:
        self.views, self.config, self.tau = views, config, tau
        self.random = np.random.default_rng(config.seed)
        self.order: list[int] = []
        self.offset = self.random.random()

    def draw(self, number: int, share_done: float) -> Sample:
        """The next view, each one once per round, and its dial value.

        Args:
            number: of the sample in the run, from 0.
            share_done: of the steps or the time budget, in [0, 1].
        """
        if not self.order:
            self.order = self.random.permutation(len(self.views)).tolist()
        view, config = self.views[self.order.pop()], self.config
        if isinstance(view, PseudoView):
            view = view.moved(self.random)
        dial = self.dial(number, share_done)
        halved = dial > 1 and share_done < config.coarse and view.camera.halvable
        view = view.halved() if halved else view
        return Sample(view, dial, self.counted(), halved)

    def counted(self) -> float | None:
        """A log-uniform dial value that Gaussians are only counted at; None if there is no target-count curve."""
        if not self.config.has_target_count:
            return None
        return self.config.beyond(COUNTED, self.tau) ** self.random.random()

    def dial(self, number: int, share_done: float) -> float:
        """The dial value of a step: with the probability ``full_share`` 1 or 0, else (log-)uniform from 1 on.

        The probability falls linearly to ``full_final`` of itself: s = 1 is learned before the far end of the dial.
        Steps at s = 0 train what cameras nearer than the photographs see, and viewers that do not know the dial. With
        max_sv 1 there is one dial value.

        Multiples of the golden ratio modulo 1 are spread more evenly than random numbers, in every stretch of a run:
        0.05 dB at s = 5 on plush_half.
        """
        place, config = (self.offset + number * GOLDEN) % 1, self.config
        full = config.full_share * (1 - (1 - config.full_final) * share_done)
        if config.max_sv == 1:
            return 1.0
        if place < full:
            return 0.0 if place < UNATTENUATED * full else 1.0
        place, end = (place - full) / (1 - full), config.beyond(RENDERED, self.tau)
        return 1 + (end - 1) * place if config.sampling == "uniform" else end**place

    def state(self) -> tuple[dict[str, Any], tuple[int, ...]]:
        """Everything that later samples depend on: the generator's state, and the order."""
        return dict(self.random.bit_generator.state), tuple(self.order)

    def restore(self, random: dict[str, Any], order: tuple[int, ...]) -> None:
        """The inverse of ``state``.

        Raises:
            ClodError: they are of other views, or damaged.
        """
        if not all(0 <= view < len(self.views) for view in order) or len(set(order)) < len(order):
            raise ClodError(OTHER_RUN)
        try:
            self.random.bit_generator.state = random
        except (KeyError, OverflowError, TypeError, ValueError) as error:
            raise ClodError(f"the training state's random state is damaged ({error!r}); start over") from error
        self.order = list(order)
