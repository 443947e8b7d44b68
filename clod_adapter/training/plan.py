"""The plan: what of a checkpoint is trained, what a scene does not need of it, and by which numbers."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

from torch import Tensor

from clod_adapter.adapter import trim
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.training.ablation import largest_change
from clod_adapter.training.distributed import ProcessGroup
from clod_adapter.training.loop import Adapted, adapt
from clod_adapter.training.objective import TrainableSubset
from clod_adapter.training.state import Progress, TrainingState

RATES = {
    "means": "lr_means", "quats": "lr_quats", "scales": "lr_scales", "opacities": "lr_opacities", "sh0": "lr_sh0",
}  # fmt: skip
FIELDS = {"scales": "log_scales", "opacities": "opacity_logits"}  # of Gaussians, where they are called otherwise
NAMES = ("bands", "unseen", *RATES)


@dataclass(frozen=True)
class Decision:
    """What is done with one thing, and why.

    Attributes:
        verdict: "kept" or "left out", of an attribute "trained" or "frozen".
        number: what was measured, in ``unit``; None where nothing was.
        why: what the number is, or the reason without one.
        name: which of NAMES ``Override`` has it by; empty where there is nothing to choose.
    """

    what: str
    verdict: str
    number: float | None
    unit: str
    why: str
    name: str = ""

    @property
    def measured(self) -> str:
        """The number as it is shown."""
        if self.number is None:
            return "-"
        return f"{self.number:.3f} {self.unit}" if self.unit else f"{self.number:,.0f}"


@dataclass(frozen=True)
class Override:
    """What is decided beforehand, whatever its numbers: any of NAMES.

    Raises:
        ClodError: there is no such thing, or it is in both.
    """

    keep: frozenset[str] = frozenset()
    leave_out: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        for name in sorted((self.keep | self.leave_out) - set(NAMES)):
            raise ClodError(f"{name!r} is nothing that a plan decides; it decides {', '.join(NAMES)}")
        for name in sorted(self.keep & self.leave_out):
            raise ClodError(f"{name!r} is to be both kept and left out; choose one")


@dataclass(frozen=True)
class Plan:
    """What is trained, of which Gaussians.

    Attributes:
        decisions: one for each thing that was looked at.
        start: the whole base's rows with the sigma_d that training starts from, without the bands left out.
        kept: ``[N]`` bool, the rows that are trained; None for all of them.
        sh_degree: of what is trained.
        config: with step size 0 for what stays frozen.
        begun: what training goes on from where its first steps are done already; the first ``adapt`` takes it away.
        seconds: wall time of "bands", "unseen" (what the start would not look at) and "probe" (without the steps of the
            training), and of the "start".
    """

    decisions: tuple[Decision, ...]
    start: Gaussians
    kept: Tensor | None
    sh_degree: int
    config: AdaptConfig
    begun: list[TrainingState] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def frozen(self) -> tuple[str, ...]:
        """The attributes that are not tuned, as NAMES has them."""
        return tuple(name for name, rate in RATES.items() if not getattr(self.config, rate))

    @cached_property
    def lean(self) -> Gaussians:
        """What is to be trained."""
        return trim(self.start, self.kept, None)

    @property
    def part(self) -> TrainableSubset:
        """For ``train.adapt`` of ``lean``: the count law remains a share of all Gaussians."""
        return TrainableSubset(len(self.start) if self.kept is None else int(self.kept.sum()), total=len(self.start))

    def adapt(
        self,
        scene: Scene,
        progress: Callable[[Progress], None] | None = None,
        resume: TrainingState | None = None,
        peers: ProcessGroup | None = None,
    ) -> Adapted:
        """``train.adapt`` of what is to be trained; the count law remains a share of all Gaussians."""
        if resume is None and self.begun:  # and let go of it, which is as large as all that is trained
            return adapt(self.lean, scene, self.config, progress, self.begun.pop(), part=self.part, peers=peers)
        return adapt(self.lean, scene, self.config, progress, resume, part=self.part, peers=peers)

    def whole(self, base: Gaussians, lean: Gaussians) -> Gaussians:
        """``lean``, trained, with what was left out put back: rows with the base's values and their start's sigma_d.

        Args:
            base: what the plan was made for.
        """
        if not self.trims(base):
            return lean
        rows = slice(None) if self.kept is None else self.kept
        values = base.replace(sigma_d=self.start.sigma_d, attenuation=lean.attenuation).tensors()
        for name, new in lean.tensors().items():
            if name == "shN" and self.config.lr_shN == 0:
                continue  # the base's, without a copy of the largest part
            values[name] = values[name].detach().clone()
            bands = slice(new.shape[1]) if name == "shN" else ...
            values[name][rows, bands] = new
        return lean.replace(**values)

    def trims(self, base: Gaussians) -> bool:
        """Whether anything is left out that need not be written."""
        return self.kept is not None or self.sh_degree < base.sh_degree

    def bound(self, base: Gaussians, scene: Scene, progress: Callable[[int, int], None] | None = None) -> Decision:
        """What not writing it does to the base's pictures, of all views, at full detail."""
        less, views = trim(base, self.kept, self.sh_degree), len(scene.train) + len(scene.test)

        def report(before: int) -> Callable[[int, int], None]:
            return lambda done, _: progress(before + done, views) if progress else None

        seen_at, lost = largest_change(base, less, scene.train, report(0))
        new_at, more = largest_change(base, less, scene.test, report(len(scene.train)))
        why = f"lost on all training views, a pixel at most {seen_at:.2g}"
        if scene.test:
            why += f"; held out {more:.3f} dB, {new_at:.2g}"
        return Decision("what is left out", "trimmed", lost, "dB", why)

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        seconds = {name: round(value, 3) for name, value in self.seconds.items()}
        decisions = [asdict(decision) | {"measured": decision.measured} for decision in self.decisions]
        return {"decisions": decisions, "seconds": seconds}


def freezing(config: AdaptConfig, names: Collection[str]) -> AdaptConfig:
    """The settings with these attributes frozen."""
    rates: dict[str, Any] = {RATES[name]: 0.0 for name in names}
    return replace(config, **rates)
