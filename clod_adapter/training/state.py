"""The state that training can be resumed from, its file, and the result of training."""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from clod_adapter.adapter import Adapter, extract
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.file_formats import reject_irregular
from clod_adapter.io.tensor_file import read_tensors, write_tensors

KEY = "clod_adapter_state"  # of the JSON document in the metadata of a file
OTHER_RUN = (
    "the training state is of other Gaussians, views or settings; use those it was saved with"
)


class StateRejected(ClodError):
    """A training state does not fit the run, or is damaged."""


@dataclass(frozen=True)
class TrainingState:
    """Everything that later steps depend on, except the base, the views and the config.

    Attributes:
        tensors: by kind and name, as in ``parameter.means``: of each trained attribute its
            ``parameter``, Adam's ``first`` and ``second`` moment, and the ``mean`` if there is one.
            float32. ``steps.kept`` and ``steps.all`` count Adam's steps of each row of parameters
            that move where the dial keeps the row, or always; int32.
        random, order: of ``schedule.ViewSampler``.
        loss: its running mean; averaged: the number of steps in the mean.
        steps, seconds: of training; start_seconds: before it.
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
        counted = 0 <= self.averaged <= self.steps < 2**31
        if not (counted and 0 <= self.seconds < math.inf and 0 <= self.start_seconds < math.inf):
            raise StateRejected(
                "the training state has impossible counts of steps or seconds; start over"
            )

    def check(self, expected: dict[str, Tensor]) -> None:
        """Rejects a state of another run than that with tensors ``expected``, and values that
        training cannot produce.
        """
        if _layout(expected) != _layout(self.tensors):
            raise StateRejected(OTHER_RUN)
        for name, values in self.tensors.items():
            kind, _, attribute = name.partition(".")
            if kind == "steps":  # an index in compiled code, which does not check it
                sound = (values >= 0) & (values <= self.steps)
            elif kind == "second":
                sound = values >= 0  # and not NaN
            elif kind == "first":  # Adam's is at most 7.3 times the root of the second
                sound = values.abs() <= 10 * self.tensors[f"second.{attribute}"].sqrt() + 1e-15
            else:  # an infinite opacity does not change
                sound = values.isfinite() | (values == expected[f"parameter.{attribute}"])
            if not sound.all():
                raise StateRejected(
                    f"the training state has impossible values of {name}; start over"
                )


def _layout(tensors: dict[str, Tensor]) -> dict[str, tuple[Any, ...]]:
    return {name: (tensor.shape, tensor.dtype) for name, tensor in tensors.items()}


@dataclass(frozen=True)
class Adapted:
    """The result of ``adapt``.

    Attributes:
        gaussians: with ``sigma_d`` and ``attenuation``.
        steps: training steps done.
        seconds: wall time of the training loop; start_seconds: before it. Both include the run that
            was resumed.
        interrupted: training ended early: the listener returned False, Ctrl-C, a process was lost,
            or the loss of a step was not finite.
        lost: which process was lost; failed: which step's loss was not finite.
        held: the number of Gaussians that some step of this call did not move because their
            gradient was not finite.
        signalled: a Ctrl-C, or another signal with Python's own handler, arrived.
    """

    gaussians: Gaussians
    steps: int
    seconds: float
    start_seconds: float
    interrupted: bool
    lost: str | None = None
    failed: str | None = None
    held: int = 0
    signalled: bool = False

    @property
    def notes(self) -> list[str]:
        """A line each on what ended training early and what it did not move."""
        lines = list[str]()
        if self.lost:
            lines.append(f"training ended at step {self.steps}: {self.lost}")
        if self.failed:
            lines.append(f"training ended early, and the result so far is written: {self.failed}")
        if self.held:
            lines.append(
                f"{self.held:,} Gaussians were not moved by some steps: their gradients were not"
                " finite"
            )
        return lines

    def __repr__(self) -> str:
        ended = ", interrupted" if self.interrupted else ""
        return f"Adapted({self.gaussians!r}, {self.steps:,} steps, {self.seconds:.1f} s{ended})"


def extract_adapter(base: Checkpoint, adapted: Adapted, config: AdaptConfig) -> Adapter:
    """The adapter of a training of ``base`` with ``config``."""
    return extract(
        base.gaussians,
        adapted.gaussians,
        fingerprint=base.fingerprint,
        config=asdict(config),
        origin=base.origin,
    )


def save_state(path: str | Path, state: TrainingState, run_metadata: dict[str, Any]) -> None:
    """Writes a state, and plain JSON that identifies its run; loading gives the same bits."""
    about = dict(vars(state))
    del about["tensors"]
    about |= {"attenuation": asdict(state.attenuation), "belongs": run_metadata}
    with atomic_path(path) as temporary:
        write_tensors(temporary, state.tensors, {KEY: json.dumps(about)})


def load_state(path: str | Path) -> tuple[TrainingState, dict[str, Any]]:
    """Reads a state, and the metadata of the run that saved it."""
    path = Path(path)
    reject_irregular(path, "delete it to start over")
    with rejected_if_damaged(
        path, "is not a training state or is damaged", "delete it to start over"
    ):
        tensors, metadata = read_tensors(path)
        about = json.loads(metadata[KEY])
        run_metadata = dict(about.pop("belongs"))
        attenuation = AttenuationConfig(**about.pop("attenuation"))
        state = TrainingState(
            tensors,
            attenuation,
            random=dict(about["random"]),
            order=tuple(map(int, about["order"])),
            loss=float(about["loss"]),
            averaged=int(about["averaged"]),
            steps=int(about["steps"]),
            seconds=float(about["seconds"]),
            start_seconds=float(about["start_seconds"]),
        )
        return state, run_metadata
