"""The training plan: what is trained, what is left out because the scene does not need it, and the measurements."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from clod_adapter.adapter import trim, with_dial
from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians, with_near
from clod_adapter.losses import psnr
from clod_adapter.progress import Listener, Phase, tell, within
from clod_adapter.render import render
from clod_adapter.training.dial import TrainableSubset
from clod_adapter.training.distributed import ProcessGroup
from clod_adapter.training.loop import Adapted, adapt
from clod_adapter.training.state import TrainingState

RATES = {name: f"lr_{name}" for name in ("means", "quats", "scales", "opacities", "sh0")}
NAMES = ("bands", "unseen", *RATES)
NOT_NEEDED = "not needed"  # the verdict on a step that does not apply to the scene


@dataclass(frozen=True)
class Decision:
    """One line of the plan.

    Attributes:
        what: the part of the checkpoint.
        verdict: "kept", "left out", of an attribute "frozen", or NOT_NEEDED.
        number: the measured effect, in ``unit``; None if nothing was measured.
        why: what the number is, or the reason if there is none.
        name: the name in NAMES by which ``Override`` changes it; empty if there is nothing to change.
    """

    what: str
    verdict: str
    number: float | None
    unit: str
    why: str
    name: str = ""

    @property
    def measured(self) -> str:
        """The number as text."""
        if self.number is None:
            return "-"
        return f"{self.number:.3f} {self.unit}" if self.unit else f"{self.number:,.0f}"


@dataclass(frozen=True)
class Override:
    """Decisions that are fixed in advance, without a measurement; both sets are subsets of NAMES.

    Attributes are trained unless ``leave_out`` has them.

    Raises:
        ClodError: a name is unknown, or in both sets.
    """

    keep: frozenset[str] = frozenset()
    leave_out: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        for name in sorted((self.keep | self.leave_out) - set(NAMES)):
            raise ClodError(f"{name!r} is not part of a plan; the names are {', '.join(NAMES)}")
        for name in sorted(self.keep & self.leave_out):
            raise ClodError(f"{name!r} is both kept and left out; choose one")


@dataclass(frozen=True)
class Plan:
    """What is trained, and how.

    Attributes:
        decisions: one for each part of the checkpoint.
        start: all rows of the base with the initial dial, and far ones that are added, without the SH degrees that are
            left out.
        kept: ``[N]`` bool, the rows that are trained; None for all.
        sh_degree: the SH degree that is trained.
        config: with learning rate 0 for frozen attributes.
        seconds: wall time of "bands", of "unseen" beyond the initialization, and of the initialization, "start".
    """

    decisions: tuple[Decision, ...]
    start: Gaussians
    kept: Tensor | None
    sh_degree: int
    config: AdaptConfig
    seconds: dict[str, float]

    @property
    def lean(self) -> Gaussians:
        """The Gaussians that are trained; a copy where rows are left out."""
        return trim(self.start, self.kept, None)

    @property
    def subset(self) -> TrainableSubset | None:
        """For ``loop.adapt`` of ``lean``: the target counts remain shares of all Gaussians."""
        if self.start.near is not None:
            return None
        return TrainableSubset(len(self.start) if self.kept is None else int(self.kept.sum()), total=len(self.start))

    def adapt(
        self,
        scene: Scene,
        progress: Listener | None = None,
        resume: TrainingState | None = None,
        group: ProcessGroup | None = None,
    ) -> Adapted:
        """``loop.adapt`` of ``lean``."""
        return adapt(self.lean, scene, self.config, progress, resume, subset=self.subset, group=group)

    def whole(self, base: Gaussians, lean: Gaussians) -> Gaussians:
        """``lean`` after training, together with what was left out: the base's values and the initial dial.

        Args:
            base: the checkpoint that the plan was made for.
        """
        if not self.trims(base):
            return lean
        if lean.near is not None:
            return with_near(base, lean.select(~lean.near))
        rows = slice(None) if self.kept is None else self.kept
        values = with_dial(base, self.start.sigma_d, lean.attenuation, self.start.growth_d).tensors()
        for name, new in lean.tensors().items():
            if name == "shN" and self.config.lr_shN == 0:
                continue  # the base's, without a copy of the largest part
            values[name] = values[name].detach().clone()
            bands = slice(new.shape[1]) if name == "shN" else ...
            values[name][rows, bands] = new
        return lean.replace(**values)

    def trims(self, base: Gaussians) -> bool:
        """Whether Gaussians or SH degrees are left out."""
        return self.kept is not None or self.sh_degree < base.sh_degree

    def trimming_effect(self, base: Gaussians, scene: Scene, progress: Listener | None = None) -> Decision:
        """How much the base's renderings of all views at full detail change without what is left out."""
        less, views = trim(base, self.kept, self.sh_degree), len(scene.train) + len(scene.test)
        seen_at, lost = largest_change(base, less, scene.train, within(progress, 0, views))
        new_at, more = largest_change(base, less, scene.test, within(progress, len(scene.train), views))
        why = f"loss on all training views, largest change of a pixel {seen_at:.2g}"
        if scene.test:
            why += f"; held out {more:.3f} dB, {new_at:.2g}"
        return Decision("what is left out", "trimmed", lost, "dB", why)

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        seconds = {name: round(value, 3) for name, value in self.seconds.items()}
        decisions = [asdict(decision) | {"measured": decision.measured} for decision in self.decisions]
        return {"decisions": decisions, "seconds": seconds}


@torch.no_grad()
def largest_change(
    base: Gaussians, less: Gaussians, views: Sequence[View], progress: Listener | None = None
) -> tuple[float, float]:
    """The largest difference of a channel between renderings of the two, in [0, 1], and the mean loss of PSNR in dB."""
    largest, lost = 0.0, []
    for done, view in enumerate(views, 1):
        with_all, without = (render(each, view.camera).image.clamp(0, 1) for each in (base, less))
        largest = max(largest, float((with_all - without).abs().max()))
        lost.append(psnr_change(psnr(with_all, view.image), psnr(without, view.image)))
        tell(progress, Phase.TRIMMING, done, len(views))
    return largest, fmean(lost) if lost else 0.0


def psnr_change(this: float, that: float) -> float:
    """dB between two PSNR; 0 where both are infinite."""
    return 0.0 if this == that else this - that
