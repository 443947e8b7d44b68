"""Where a training stands: as it is told while it runs, as it can be gone on from, and as it ended."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians

OTHER_RUN = "the training state is of other Gaussians, views or settings; give those it was saved with"


class StateRefused(ClodError):
    """A training state cannot be gone on from: it is of another run, or damaged."""


@dataclass(frozen=True)
class TrainingState:
    """All that the steps to come depend on, besides the base, the views and the config.

    ``adapt`` goes on from it and ends with the bits that it would have ended with undisturbed, on as many threads and
    processes.

    Attributes:
        tensors: by kind and name, as in ``parameter.means``: of each attribute that changes (what does not is the
            base's) its ``parameter``, Adam's ``first`` and ``second`` moment and a row's number of ``steps``, and,
            where there is one by now, the ``mean`` that will be the outcome. float32 and, the steps, int32.
        attenuation: how sigma_d is to be read.
        random: the state of NumPy's generator; order: the views to come in this round, the next one last.
        loss: its running mean; averaged: how many steps are in the mean.
        steps, seconds: done and spent in training; start_seconds: spent before it.

    Raises:
        StateRefused: it counts steps or seconds that cannot be.
    """

    tensors: dict[str, Tensor]
    attenuation: AttenuationConfig
    random: dict[str, Any]
    order: tuple[int, ...]
    loss: float
    averaged: int
    steps: int
    seconds: float
    start_seconds: float

    def __post_init__(self) -> None:
        times = (self.seconds, self.start_seconds)
        possible = 0 <= self.averaged <= self.steps < 2**31 and all(0 <= seconds < math.inf for seconds in times)
        if not possible:
            raise StateRefused("the training state counts steps or seconds that cannot be; start afresh")

    def check(self, own: dict[str, Tensor]) -> None:
        """Refuses a state whose tensors are not like a run's ``own``, or that cannot be.

        Raises:
            StateRefused: it is of another run, or damaged.
        """
        shapes = [{name: (t.shape, t.dtype) for name, t in tensors.items()} for tensors in (own, self.tensors)]
        if shapes[0] != shapes[1]:
            raise StateRefused(OTHER_RUN)
        for name, values in self.tensors.items():
            kind, _, attribute = name.partition(".")
            if kind == "steps":  # an index in compiled code, which checks none
                sound = (values >= 0) & (values <= self.steps)
            elif kind == "second":
                sound = values >= 0  # and not NaN
            elif kind == "first":  # Adam's is at most 7.3 times the root of the second
                sound = values.abs() <= 10 * self.tensors[f"second.{attribute}"].sqrt() + 1e-15
            else:  # an infinite opacity stays what it is in the base
                sound = values.isfinite() | (values == own[f"parameter.{attribute}"])
            if not bool(sound.all()):
                raise StateRefused(f"the training state has {name} that cannot be; start afresh")


@dataclass(frozen=True)
class Progress:
    """Where an adaptation stands; handed to the progress callback.

    Attributes:
        phase: "start" (a view a step), "order" (a Gaussian a step: who leaves before whom) or "train"; of a block
            also "beside", "targets" and "quotas" (a view a step).
        done, total: steps of the phase.
        seconds: since training began; before it, since the adaptation did.
        share: of the phase that is done, by steps or by time budget, whichever is further.
        loss: running mean of the photometric loss, NaN before the first step.
        gaussians: gives the state now (before training, the base; within the last ``average`` of it, the mean so
            far); it shares memory with what is being trained, so use it within the callback.
        state: gives what training can be resumed from, likewise; None before training.
        lost: why training ends here, where a process that trained along is gone or an error ends it.
    """

    phase: str
    done: int
    total: int
    seconds: float
    share: float
    loss: float
    gaussians: Callable[[], Gaussians]
    state: Callable[[], TrainingState] | None = None
    lost: str | None = None


@dataclass(frozen=True)
class Adapted:
    """The outcome of ``adapt``.

    Attributes:
        gaussians: with ``sigma_d`` and ``attenuation``.
        steps: training steps done.
        seconds: wall time of the training loop; start_seconds: of what comes before it. Of a resumed training both
            count from its first beginning.
        interrupted: a KeyboardInterrupt, the loss of a process, or a loss that is not finite ended it early.
        lost: which process was lost; failed: which step's loss was not finite.
        waiting, exchanging: of these seconds, in this call, those spent on other processes (``ProcessGroup``).
        held: Gaussians that some step of this call did not move, as their gradients were not finite.
    """

    gaussians: Gaussians
    steps: int
    seconds: float
    start_seconds: float
    interrupted: bool
    lost: str | None = None
    waiting: float = 0.0
    exchanging: float = 0.0
    failed: str | None = None
    held: int = 0
