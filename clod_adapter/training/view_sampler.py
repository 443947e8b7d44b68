"""Random sampling of the training views and of the dial values that they are rendered at."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.pseudo_views import PseudoView
from clod_adapter.training.state import OTHER_RUN

COUNTED_BEYOND = 1.5  # times max_sv: counts at the end of the dial follow the curve as they do within it
# Until this share of the steps half of the views are rendered at two dial values in place of 1 and one other: what
# remains at the far end has the longest way to go, and s = 1, where a checkpoint begins, the shortest.
FAR_FIRST = 0.5


class Sample(NamedTuple):
    """What one step does with one view.

    Attributes:
        view: camera and photograph.
        rendered: the dial values that it is rendered at.
        counted: a dial value that Gaussians are only counted at; None if there is no target-count curve.
    """

    view: View
    rendered: list[float]
    counted: float | None = None


class ViewSampler:
    """Samples views and dial values from ``config.seed``; the same in every process.

    Args:
        far_first: FAR_FIRST, or another share where ``config`` is of a part of the training.

    Attributes:
        order: the numbers of the remaining views of this round, the next one last.
    """

    def __init__(self, views: tuple[View, ...], config: AdaptConfig, far_first: float = FAR_FIRST) -> None:
        self.views, self.config, self.far_first = views, config, far_first
        self.random = np.random.default_rng(config.seed)
        self.order: list[int] = []

    def draw(self, share_done: float) -> Sample:
        """The next view, each one once per round, and its dial values, the smallest first.

        Args:
            share_done: of the steps or the time budget, in [0, 1].
        """
        if not self.order:
            self.order = self.random.permutation(len(self.views)).tolist()
        view, config = self.views[self.order.pop()], self.config
        if isinstance(view, PseudoView):
            view = view.moved(self.random)
        uniform, full = self.random.random(), self.random.random() < config.full_share
        drawn = 1 + (config.max_sv - 1) * uniform if config.sampling == "uniform" else config.max_sv**uniform
        if config.sampling != "pair":
            rendered = [1.0 if full else drawn]
        elif config.max_sv == 1:
            rendered = [1.0]
        elif self.random.random() < 0.5 and share_done < self.far_first:
            rendered = sorted([drawn, config.max_sv ** ((uniform + 0.5) % 1)])
        else:
            rendered = [1.0, drawn]
        if not config.has_target_count:
            return Sample(view, rendered)
        return Sample(view, rendered, (COUNTED_BEYOND * config.max_sv) ** self.random.random())

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
