"""The training plan: what is trained, what is left out because the scene does not need it, and the
measurements.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

from clod_adapter.adapter import detach
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians, with_near
from clod_adapter.progress import Listener
from clod_adapter.training.distributed import ProcessGroup
from clod_adapter.training.far_reach import fit_far_reach
from clod_adapter.training.loop import Adapted, adapt
from clod_adapter.training.pseudo_views import only_pseudo
from clod_adapter.training.state import TrainingState

RATES = {name: f"lr_{name}" for name in ("means", "quats", "scales", "opacities", "sh0")}
NAMES = ("bands", *RATES)
NOT_NEEDED = "not needed"  # the verdict on a step that does not apply to the scene


@dataclass(frozen=True)
class Decision:
    """One line of the plan.

    Attributes:
        what: the part of the checkpoint.
        verdict: "kept", "left out", of an attribute "frozen", or NOT_NEEDED.
        why: what the number is, or the reason if there is none.
        name: the name in NAMES by which ``Override`` changes it; empty if there is nothing to
            change.
        number: the measured effect, in ``unit``; None if nothing was measured.
    """

    what: str
    verdict: str
    why: str
    name: str = ""
    number: float | None = None
    unit: str = ""

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
    """Decisions on what is trained, and how.

    Attributes:
        base: the checkpoint that the plan was made for.
        decisions: one for each part of the checkpoint.
        start: what training begins with: the base with its initial dial, and far Gaussians that are
            added, without the SH degrees that are left out.
        sh_degree: the SH degree that is trained.
        config: with learning rate 0 for frozen attributes.
        seconds: wall time of "bands", and of what training begins with, "start".
    """

    base: Gaussians
    decisions: tuple[Decision, ...]
    start: Gaussians
    sh_degree: int
    config: AdaptConfig
    seconds: dict[str, float]

    def adapt(
        self,
        scene: Scene,
        progress: Listener | None = None,
        resume: TrainingState | None = None,
        group: ProcessGroup | None = None,
    ) -> Adapted:
        """``loop.adapt`` of ``start``; the result has the SH degrees that were left out again, and
        without photographs the reach of far Gaussians that is best at equal counts.

        The listener is given the Gaussians without them (``restore_excluded``).
        """
        adapted = adapt(self.start, scene, self.config, progress, resume, group=group)
        gaussians = adapted.gaussians
        if self.start.near is not None and not adapted.interrupted and only_pseudo(scene.train):
            gaussians = fit_far_reach(gaussians, scene.train, progress)
        start_seconds = adapted.start_seconds + self.seconds["start"]
        return replace(
            adapted, gaussians=self.restore_excluded(gaussians), start_seconds=start_seconds
        )

    def restore_excluded(self, trained: Gaussians) -> Gaussians:
        """``trained``, which training works on, together with the SH degrees that were left out, of
        the base's rows.
        """
        base = self.base
        if self.sh_degree == base.sh_degree:
            return trained
        if trained.near is not None:
            return with_near(detach(base), trained.select(~trained.near))
        harmonics = base.shN.detach().clone()
        if self.config.lr_shN > 0:
            harmonics[:, : trained.shN.shape[1]] = trained.shN
        return trained.replace(shN=harmonics)

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        seconds = {name: round(value, 3) for name, value in self.seconds.items()}
        decisions = [
            asdict(decision) | {"measured": decision.measured} for decision in self.decisions
        ]
        return {"decisions": decisions, "seconds": seconds}
