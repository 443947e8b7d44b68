"""The schedule of a training: which view a step renders, at which dial value and size, and how far
it moves.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.pseudo_views import PseudoView
from clod_adapter.training.state import OTHER_RUN

GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class Schedule:
    """Settings that change over a training; docs/method.md has the measurements."""

    full: float = 0.5  # share of the steps at s = 0 and s = 1 at first
    unattenuated: float = 0.25  # of these: at s = 0, where every Gaussian is as it is stored
    # the share that full falls to linearly: s = 1 is learned before the far end
    full_final: float = 0.4
    # share of the training in which steps beyond s = 1 have photographs of half the size
    coarse: float = 0.9
    # final learning rates as a share of the first ones, between which they decay exponentially
    lr_final: float = 0.1
    # share of the steps so far, at the end, whose parameters are averaged for the result
    average: float = 0.2
    # Times max_sv, the largest dial value of steps: quality and counts do not break off at max_sv.
    rendered: float = 1.25
    counted: float = 1.5  # and of counts
    even: bool = False  # whether dial values are uniform, not log-uniform

    def dial(self, place: float, share_done: float, end: float) -> float:
        """The dial value at ``place`` in [0, 1): 0, 1, or from 1 to ``end``.

        Steps at s = 0 train what cameras nearer than the photographs see, and viewers that do not
        know the dial.
        """
        full = self.full * (1 - (1 - self.full_final) * share_done)
        if place < full:
            return 0.0 if place < self.unattenuated * full else 1.0
        return 1 + (end - 1) * place if self.even else end ** ((place - full) / (1 - full))


OURS = Schedule()
# Far Gaussians alone are trained, not near ones, which s = 0 shows. With coarse 0.9 images at a
# tenth lose 0.4 dB on the demo, whose photographs are exact, and gain 0.04 dB on plush_half, at
# less SSIM.
FAR = replace(OURS, full=0.33, unattenuated=0.0, coarse=0.5)
# One s ~ U(1, max_sv) a step, of whole photographs; no average of parameters.
PAPER = Schedule(
    full=0.0,
    coarse=0.0,
    lr_final=0.05,
    average=0.0,
    rendered=1.0,
    counted=0.0,
    even=True,
)


class Sample(NamedTuple):
    """A view, perhaps of half its size, the dial value it is rendered at, and another, where
    Gaussians are counted.
    """

    view: View
    dial: float
    counted: float | None = None
    halved: bool = False


class ViewSampler:
    """Samples views and dial values from ``config.seed``; the same in every process.

    ``order`` has the numbers of the remaining views of this round, the next one last.
    """

    def __init__(
        self,
        views: tuple[View, ...],
        config: AdaptConfig,
        schedule: Schedule = OURS,
    ) -> None:
        self.views = views
        self.max_sv = config.max_sv
        self.schedule = schedule
        self.random = np.random.default_rng(config.seed)
        self.order: list[int] = []
        self.offset = self.random.random()

    def draw(self, number: int, share_done: float) -> Sample:
        """The next view, each one once per round, and its dial value; ``number`` counts samples
        from 0.
        """
        if not self.order:
            self.order = self.random.permutation(len(self.views)).tolist()
        view = self.views[self.order.pop()]
        if isinstance(view, PseudoView):
            view = view.moved(self.random)
        dial = self.dial(number, share_done)
        halved = dial > 1 and share_done < self.schedule.coarse and view.camera.halvable
        view = view.halved() if halved else view
        return Sample(view, dial, self.counted(), halved)

    def counted(self) -> float | None:
        """A log-uniform dial value that Gaussians are only counted at; None with a single dial
        value.
        """
        if self.max_sv == 1 or self.schedule.counted == 0:
            return None
        return (self.schedule.counted * self.max_sv) ** self.random.random()

    def dial(self, number: int, share_done: float) -> float:
        """The dial value of a step, by ``Schedule.dial``; with max_sv 1 there is one.

        Multiples of the golden ratio modulo 1 are spread more evenly than random numbers, in every
        stretch of a run: 0.05 dB at s = 5 on plush_half.
        """
        if self.max_sv == 1:
            return 1.0
        place = (self.offset + number * GOLDEN) % 1
        return self.schedule.dial(place, share_done, self.schedule.rendered * self.max_sv)

    def state(self) -> tuple[dict[str, Any], tuple[int, ...]]:
        """Everything that later samples depend on: the generator's state, and the order."""
        return dict(self.random.bit_generator.state), tuple(self.order)

    def restore(self, random: dict[str, Any], order: tuple[int, ...]) -> None:
        """The inverse of ``state``."""
        known = all(0 <= view < len(self.views) for view in order)
        if not known or len(set(order)) < len(order):
            raise ClodError(OTHER_RUN)
        try:
            self.random.bit_generator.state = random
        except (KeyError, OverflowError, TypeError, ValueError) as error:
            raise ClodError(
                f"the training state's random state is damaged ({error!r}); start over"
            ) from error
        self.order = list(order)
