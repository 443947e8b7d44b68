"""Every choice the paper leaves open, as documented fields of frozen configs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any

from clod_adapter.errors import ClodError

NORMALIZERS = ("max", "quantile", "scene")
CUTS = ("hard", "soft")
STARTS = ("importance", "error", "constant", "identity")
PARAMETERS = ("log", "linear")
SAMPLINGS = ("pair", "log", "uniform")
COUNT_TERMS = ("law", "paper")
SH_COUNTS = {0: 1, 1: 4, 2: 9, 3: 16, 4: 25}  # spherical harmonics of each degree


def option(default: Any, help: str) -> Any:
    """A config field whose help is also the command line's."""
    return field(default=default, metadata={"help": help})


def require(ok: bool, name: str, value: object, what: str) -> None:
    """Raises ClodError naming the field, its value and what it must be."""
    if not ok:
        raise ClodError(f"{name} is {value}, it must be {what}")


@dataclass(frozen=True, kw_only=True)
class AttenuationConfig:
    """How a stored ``sigma_d`` is to be read. Travels with the file; the defaults are what adapting writes by default.

    The cut keeps a Gaussian iff its attenuated opacity exceeds ``tau * virtual_scale``, and draws it with that
    opacity (``hard``, the paper's) or with what is above the threshold (``soft``; ``attenuation.attenuate``). The
    normaliser D turns a distance into the ``d'`` of the equation:

    - ``scene``: one constant, ``scene_distance``, for every view; 1 for a sigma_d in world units, as files have it;
    - ``quantile``: the ``quantile`` of the distances of the Gaussians in the view frustum;
    - ``max``: their maximum, the paper's form.
    """

    tau: float = option(0.02, "base opacity threshold of the cut; rasterizers drop what is below 1/255 anyway")
    cut: str = option("soft", "how a Gaussian leaves: hard (at opacity tau s, the paper's) or soft (at 0)")
    eps: float = option(1e-8, "the paper's epsilon under sigma_d squared; keeps sigma_d = 0 defined")
    normalizer: str = option("scene", "what distances are divided by: scene, quantile or max")
    quantile: float = option(0.95, "share of the frustum's Gaussians nearer than D (normalizer quantile)")
    scene_distance: float = option(1.0, "D in world units (normalizer scene); 1 in files: sigma_d is in world units")
    reference_distance: float = option(
        0.0, "typical distance in the training views, world units, for what has no camera; 0 where it is not known"
    )
    max_sv: float = option(5.0, "largest dial value the file was trained for")

    def __post_init__(self) -> None:
        require(0 < self.tau < 1, "tau", self.tau, "between 0 and 1")
        require(self.cut in CUTS, "cut", self.cut, f"one of {', '.join(CUTS)}")
        require(0 <= self.eps < 1, "eps", self.eps, "at least 0 and below 1")
        require(self.normalizer in NORMALIZERS, "normalizer", self.normalizer, f"one of {', '.join(NORMALIZERS)}")
        require(0 < self.quantile <= 1, "quantile", self.quantile, "above 0 and at most 1")
        require(0 < self.scene_distance < math.inf, "scene_distance", self.scene_distance, "positive and finite")
        reference = self.reference_distance
        require(0 <= reference < math.inf, "reference_distance", reference, "at least 0 and finite")
        require(1 <= self.max_sv < math.inf, "max_sv", self.max_sv, "at least 1 and finite")
        require(
            self.tau * self.max_sv < 1,
            "tau",
            self.tau,
            f"below 1/max_sv = {1 / self.max_sv:.3g}, or nothing survives the cut",
        )


@dataclass(frozen=True, kw_only=True)
class ScreenFilter:
    """The screen-space filter that a checkpoint was trained with, and so has to be drawn with. Travels with the file.

    With C ``[2, 2]`` the covariance of a projected Gaussian, in px^2, a renderer draws C + variance I. With
    ``compensate`` it also multiplies the opacity by

        c = sqrt(max(0, det C / det(C + variance I)))

    so that a Gaussian that the filter widens keeps its integral, and drops it where the product is below 1/255.
    The 2D Mip filter of Mip-Splatting (Yu et al., CVPR 2024); ``rasterize_mode="antialiased"`` of gsplat and
    ``--antialiasing`` of Inria's trainer are the same with a variance of 0.3 in place of 0.1. (Inria's c is at least
    0.005, Mip-Splatting's at least 0.001; gsplat's has no such floor, and neither has this one.)
    """

    variance: float = option(0.3, "px^2 added to the covariance of every projected Gaussian")
    compensate: bool = option(False, "whether the opacity is scaled by how much that widens it")

    def __post_init__(self) -> None:
        require(1e-3 <= self.variance <= 100, "variance", self.variance, "between 0.001 and 100 px^2")
        require(isinstance(self.compensate, bool), "compensate", self.compensate, "true or false")

    @property
    def name(self) -> str | None:
        """Its name in FILTERS; None for another one."""
        return next((name for name, known in FILTERS.items() if known == self), None)

    @property
    def says(self) -> str:
        """In words."""
        return f"{self.variance:g} px^2 of blur, opacities {'' if self.compensate else 'not '}compensated for it"


CLASSIC = ScreenFilter()
FILTERS = {
    "off": CLASSIC,
    "on": ScreenFilter(compensate=True),
    "mip": ScreenFilter(variance=0.1, compensate=True),
}
"""By the names that ``--antialiasing`` has: 3DGS's own, gsplat's and Inria's with antialiasing, Mip-Splatting's."""


@dataclass(frozen=True, kw_only=True)
class AdaptConfig:
    """How an adaptation is run. docs/method.md says which defaults were measured, and what the others stand on."""

    max_sv: float = option(5.0, "largest dial value to train for")
    iters: int = option(1500, "training steps")
    batch: int = option(1, "views a step; step sizes grow with its root, so fewer steps of more views go as far")
    time_budget: float | None = option(
        None, "stop training after this many seconds, schedule included (default: no limit)"
    )
    seed: int = option(0, "seed of view order, dial values and the importance estimate")
    tau: float = option(0.02, "base opacity threshold of the cut; lowered for a checkpoint that is too faint for it")
    cut: str = option("soft", "how a Gaussian leaves: hard (at opacity tau s, the paper's) or soft (at 0)")
    eps: float = option(1e-8, "the paper's epsilon")
    normalizer: str = option("scene", "what distances are divided by: scene, quantile or max (the paper's)")
    quantile: float = option(0.95, "quantile of distances that becomes D (normalizers scene and quantile)")
    start: str = option(
        "importance",
        "first sigma_d: importance (by rank; who has a neighbour to stand in for it leaves sooner), error (by rank of "
        "removal error alone), constant (1) or identity (no fading)",
    )
    start_share: float = option(0.62, "share of Gaussians to keep at s = 1")
    parameter: str = option("log", "what is trained: log (of sigma_d) or linear (sigma_d, the paper's)")
    sampling: str = option("pair", "dial values of a step: pair (1 and one log-uniform), log, or uniform (the paper's)")
    full_weight: float = option(
        1.0, "weight of the picture at s = 1 beside that at the other dial value (sampling pair)"
    )
    full_share: float = option(0.0, "share of steps at s = 1 (samplings log and uniform)")
    exponent: float = option(1.5, "the count law: the share to keep at s is s^-exponent")
    count_term: str = option("law", "what moves the count: law (both ways, by sigma_d alone) or paper (its L_reg)")
    reg_weight: float = option(0.5, "weight of the count term (the paper's lambda_reg)")
    weight_slope: float = option(
        0.25, "k of w_s = (1 - k s/max_sv)^2; the paper has 0.5, 0 weighs all dial values alike"
    )
    temperature: float = option(0.15, "width of the straight-through count's sigmoid, in log opacity")
    ssim_weight: float = option(0.2, "weight of 1 - SSIM against L1")
    lr_sigma: float = option(0.1, "step size of log sigma_d: its largest relative change a step")
    lr_means: float = option(5.2e-4, "step size of means, times the cameras' extent")
    lr_quats: float = option(1.6e-3, "step size of quats")
    lr_scales: float = option(1.6e-2, "step size of log_scales")
    lr_opacities: float = option(0.1, "step size of opacity_logits")
    lr_sh0: float = option(4e-3, "step size of sh0")
    lr_shN: float = option(0.0, "step size of shN; 0 leaves the higher bands as they are: measured at 0.01 dB")
    lr_final: float = option(0.1, "step sizes fall exponentially to this share of their start")
    average: float = option(0.2, "the last share of the steps, over which the mean of the parameters is the outcome")

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(not isinstance(value, float) or math.isfinite(value), name, value, "finite")
        require(self.max_sv >= 1, "max_sv", self.max_sv, "at least 1")
        require(self.iters >= 0, "iters", self.iters, "at least 0")
        require(self.batch >= 1, "batch", self.batch, "at least 1")
        require(0 <= self.seed < 2**63, "seed", self.seed, "at least 0 and below 2^63")
        require(self.time_budget is None or self.time_budget > 0, "time_budget", self.time_budget, "positive seconds")
        require(0.5 < self.start_share <= 1, "start_share", self.start_share, "above 0.5 and at most 1")
        choices = {"start": STARTS, "parameter": PARAMETERS, "sampling": SAMPLINGS, "count_term": COUNT_TERMS}
        for name, allowed in choices.items():
            require(getattr(self, name) in allowed, name, getattr(self, name), f"one of {', '.join(allowed)}")
        require(0 <= self.full_share <= 1, "full_share", self.full_share, "between 0 and 1")
        require(0 <= self.full_weight < math.inf, "full_weight", self.full_weight, "at least 0 and finite")
        require(0 < self.exponent < math.inf, "exponent", self.exponent, "positive and finite")
        require(0 <= self.reg_weight < math.inf, "reg_weight", self.reg_weight, "at least 0 and finite")
        require(0 <= self.weight_slope <= 1, "weight_slope", self.weight_slope, "between 0 and 1")
        require(self.temperature > 0, "temperature", self.temperature, "positive")
        require(0 <= self.ssim_weight <= 1, "ssim_weight", self.ssim_weight, "between 0 and 1")
        require(0 < self.lr_final <= 1, "lr_final", self.lr_final, "above 0 and at most 1")
        require(0 <= self.average <= 1, "average", self.average, "between 0 and 1")
        for name in ("sigma", "means", "quats", "scales", "opacities", "sh0", "shN"):
            rate = getattr(self, f"lr_{name}")  # far longer steps would overflow float32 in the end
            require(0 <= rate <= 1e6, f"lr_{name}", rate, "between 0 and 1e6")
        self.attenuation(1.0)  # checks the rest

    @classmethod
    def paper(cls, **changes: Any) -> AdaptConfig:
        """The paper's own form, where it says; the rest, and ``changes``, as in ours.

        CLoD-GS section 3.3: one s ~ U(1, max_sv) a step, w_s with k = 0.5, its L_reg with lambda 1, distances divided
        by the frustum's largest, a hard cut, sigma_d itself trained at 1e-2. It does not give tau, the start, the
        gradient of its count and the other step sizes: 1/255 (what rasterizers drop anyway), constant 1, straight
        through a sigmoid 0.5 wide, half of ours falling to a twentieth, without a mean at the end.
        """
        own: dict[str, Any] = {
            "tau": 1 / 255, "cut": "hard", "normalizer": "max", "start": "constant", "parameter": "linear",
            "sampling": "uniform", "count_term": "paper", "reg_weight": 1.0, "weight_slope": 0.5, "lr_sigma": 1e-2,
            "temperature": 0.5, "average": 0.0, "lr_final": 0.05, "lr_means": 2.6e-4, "lr_quats": 8e-4,
            "lr_scales": 8e-3, "lr_opacities": 5e-2, "lr_sh0": 2e-3,
        }  # fmt: skip
        return cls(**{**own, **changes})

    def lighter(self, share: float) -> AdaptConfig:
        """The same with step sizes times ``share`` for everything but sigma_d."""
        names = ("lr_means", "lr_quats", "lr_scales", "lr_opacities", "lr_sh0", "lr_shN")
        return replace(self, **{name: share * getattr(self, name) for name in names})

    def attenuation(self, scene_distance: float) -> AttenuationConfig:
        """What training reads sigma_d by; ``units.in_world_units`` of it travels with the file."""
        return AttenuationConfig(
            tau=self.tau, cut=self.cut, eps=self.eps, normalizer=self.normalizer, quantile=self.quantile,
            scene_distance=scene_distance, max_sv=self.max_sv,
        )  # fmt: skip


def describe(config: Any) -> dict[str, str]:
    """The help text of each field of a config."""
    return {f.name: f.metadata["help"] for f in fields(config)}
