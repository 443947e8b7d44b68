"""What a training looks at: views in random order, and the dial values they are rendered at, all by one seed."""

from __future__ import annotations

from typing import Any

import numpy as np

from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.state import OTHER_RUN


class ViewSampler:
    """ViewSampler for as long as it is asked, the same in every process that has the same seed.

    Attributes:
        order: the views to come in this round, by number, the next one last.
    """

    def __init__(self, views: tuple[View, ...], config: AdaptConfig) -> None:
        self.views, self.config = views, config
        self.random = np.random.default_rng(config.seed)
        self.order: list[int] = []

    def draw(self) -> tuple[View, list[float]]:
        """A view (each once per round) and the dial values it is rendered at."""
        if not self.order:
            self.order = self.random.permutation(len(self.views)).tolist()
        view, config = self.views[self.order.pop()], self.config
        uniform, full = self.random.random(), self.random.random() < config.full_share
        drawn = 1 + (config.max_sv - 1) * uniform if config.sampling == "uniform" else config.max_sv**uniform
        if config.sampling == "pair":
            return view, [1.0, drawn] if config.max_sv > 1 else [1.0]
        return view, [1.0 if full else drawn]

    def state(self) -> tuple[dict[str, Any], tuple[int, ...]]:
        """All that the draws to come depend on: the generator's state, and the order."""
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
            raise ClodError(f"the training state's random state is damaged ({error!r}); start afresh") from error
        self.order = list(order)
