"""Settings of the equation, the screen-space filter and training: frozen dataclasses, with the help
of each option.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from numbers import Integral, Real
from typing import Any

from clod_adapter.errors import ClodError

FORMS = ("ours", "paper")
FARTHEST = 3e38  # world units: a float32, as which distances are divided by it
NEAREST = 1e-30  # world units, the smallest unit of distances
STEPS, STEPS_PER_VIEW = 2500, 24.0  # of training, by default, with one view a step
PLACED_MAX_SV, PLACED_EXPONENT = 8.0, 1.75  # defaults without photographs
MULTIPLIER = 3.0  # of the distances at which levels of a set begin: PlayCanvas's default
# Gaussians that viewers draw at most on a device, by their makers; docs/formats.md has the sources.
DEVICES = {"quest3": 500_000, "phone": 1_000_000, "laptop": 2_000_000, "desktop": 4_000_000}
# By the annotation of a field, what its value is an instance of.
KINDS: dict[str, tuple[type, str]] = {
    "float": (Real, "a number"),
    "int": (Integral, "a whole number"),
    "bool": (bool, "true or false"),
    "str": (str, "text"),
}
SH_COUNTS = {0: 1, 1: 4, 2: 9, 3: 16}  # spherical harmonics of each degree


def option(
    default: Any,
    help: str,
    *,
    low: float = 0.0,
    high: float = 1e6,
    choices: tuple[str, ...] = (),
) -> Any:
    """A field with its help, also that of its command-line option, and what values it may have: a
    number from ``low`` to ``high``, or text that is one of the ``choices``.

    By default numbers go up to 1e6: powers of a dial value stay finite, and learning rates do not
    overflow float32.
    """
    about = {"help": help, "low": low, "high": high, "choices": choices}
    return field(default=default, metadata=about)


def require(ok: bool, name: str, value: object, what: str) -> None:
    """Raises ClodError unless ``ok``; the message has the field's name, its value and ``what`` it
    must be.
    """
    if not ok:
        raise ClodError(f"{name} is {value}, it must be {what}")


def check_fields(config: Any) -> None:
    """Raises ClodError for a field of another type than its annotation, or outside its range.

    Numbers of numpy, which JSON does not have, become those of Python.
    """
    for each in fields(config):
        value = getattr(config, each.name)
        annotation = each.type.removesuffix(" | None")
        if value is None and annotation != each.type:
            continue
        kind, what = KINDS[annotation]
        require(isinstance(value, kind), each.name, value, f"{what}, not {type(value).__name__}")
        if kind is str:
            choices = each.metadata["choices"]
            require(value in choices, each.name, value, f"one of {', '.join(choices)}")
        elif kind is not bool:
            low = each.metadata["low"]
            high = each.metadata["high"]
            limits = f"between {low:g} and {high:g}"
            require(low <= number(value) <= high, each.name, value, limits)
            plain = int(value) if isinstance(value, Integral) else float(value)
            object.__setattr__(config, each.name, plain)


def number(value: Any) -> float:
    """A number of Python, numpy or torch as a float; NaN, which no range contains, if it is none or
    too large.
    """
    if not isinstance(value, Real) and getattr(value, "shape", None) != ():
        return math.nan
    try:
        return float(value)
    except (OverflowError, TypeError, ValueError):
        return math.nan


@dataclass(frozen=True, kw_only=True)
class AttenuationConfig:
    """Settings of the equation that reads ``sigma_d``. Stored in the file; the defaults are those
    of adapting.

    The form ``ours`` (``attenuation.attenuate``) has distances in units of ``scene_distance``,
    which is 1 in files: sigma_d is a length of the scene. The form ``paper``
    (``equation/paper.py``) has them as a share of the largest distance in the view.

    Raises:
        ClodError: a field is out of range.
    """

    form: str = option("ours", "equation of the dial: ours, or the paper's", choices=FORMS)
    scene_distance: float = option(
        1.0,
        "unit of distances, world units; files have 1, sigma_d in world units",
        low=NEAREST,
        high=FARTHEST,
    )
    reference_distance: float = option(
        0.0,
        "median distance in the nearest training views, world units, from which on scales grow; 0"
        " if unknown",
        high=FARTHEST,
    )
    max_sv: float = option(5.0, "largest dial value of training", low=1)
    near_distance: float = option(
        0.0,
        "distance at s = 1, world units, at which far Gaussians take over from near ones; 0 without"
        " near ones",
        high=FARTHEST,
    )

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, kw_only=True)
class ScreenFilter:
    """The screen-space filter of a checkpoint's training, which rendering has to repeat. Stored in
    the file.

    With C ``[2, 2]`` the covariance of a projected Gaussian, in px^2, a renderer draws C + variance
    I. With ``compensate`` it also multiplies the opacity by

        c = sqrt(max(0, det C / det(C + variance I)))

    so that a widened Gaussian keeps its integral, and drops a Gaussian whose product is below
    1/255. The 2D Mip filter of Mip-Splatting (Yu et al., CVPR 2024);
    ``rasterize_mode="antialiased"`` of gsplat and ``--antialiasing`` of Inria's trainer are the
    same with a variance of 0.3 instead of 0.1. (Inria's c is at least 0.005, Mip-Splatting's at
    least 0.001; gsplat's and this one have no lower bound.)

    Raises:
        ClodError: the variance is not between 0.001 and 100, or ``compensate`` is not a bool.
    """

    variance: float = option(
        0.3,
        "px^2 added to the covariance of every projected Gaussian",
        low=1e-3,
        high=100,
    )
    compensate: bool = option(
        False, "whether opacities are scaled by c to compensate for the widening"
    )

    def __post_init__(self) -> None:
        check_fields(self)

    def halved(self) -> ScreenFilter:
        """The same filter in the px^2 of images of half the size, which are means of 2x2 pixels:
        ``variance / 4``.
        """
        return replace(self, variance=max(self.variance / 4, 1e-3))

    @property
    def name(self) -> str | None:
        """Its name in FILTERS; None if it is not in there."""
        return next((name for name, known in FILTERS.items() if known == self), None)

    @property
    def description(self) -> str:
        """Description for messages."""
        compensated = "compensated" if self.compensate else "not compensated"
        return f"{self.variance:g} px^2 of blur, opacities {compensated} for it"


CLASSIC = ScreenFilter()
FILTERS = {
    "off": CLASSIC,
    "on": ScreenFilter(compensate=True),
    "mip": ScreenFilter(variance=0.1, compensate=True),
}
"""Values of ``--antialiasing``: off is 3DGS, on is gsplat's and Inria's antialiasing, mip is
Mip-Splatting.
"""


@dataclass(frozen=True, kw_only=True)
class AdaptConfig:
    """Settings of training. docs/method.md has the measurement or the source of each default.

    Raises:
        ClodError: a field is out of range.
    """

    form: str = option(
        "ours",
        "training as measured here (ours) or as published (paper); AdaptConfig.paper sets it",
        choices=FORMS,
    )
    max_sv: float = option(5.0, "largest dial value to train for", low=1)
    iters: int | None = option(
        None,
        f"training steps (default: {STEPS}, or {STEPS_PER_VIEW:g} for each training view if that is"
        " more)",
        high=1e9,
    )
    batch: int = option(
        1,
        "views per step; learning rates scale with its square root",
        low=1,
        high=4096,
    )
    time_budget: float | None = option(
        None,
        "stop training after this many seconds; schedules are scaled to it (default: no limit)",
        low=1e-3,
    )
    seed: int = option(
        0,
        "seed of the view order, the dial values and the importance estimate",
        high=2**63 - 1,
    )
    start_share: float = option(
        0.62,
        "share of Gaussians to keep at s = 1 where there are no far ones",
        low=0.501,
        high=1,
    )
    exponent: float = option(
        1.5,
        "target-count curve: the target share of Gaussians at s is s^-exponent",
        low=1e-3,
    )
    reg_weight: float = option(1.0, "weight of the count loss (the paper's lambda_reg)")
    ssim_weight: float = option(0.2, "weight w of 1 - SSIM; L1 has 1 - w", high=1)
    lr_sigma: float = option(
        0.05,
        "learning rate of log sigma_d: its largest relative change per step",
    )
    growth: str = option(
        "on",
        "growth of the Gaussians that remain, by a growth_d beside sigma_d: on or off",
        choices=("on", "off"),
    )
    lr_growth: float = option(1.2e-2, "learning rate of growth_d")
    lr_means: float = option(0.06, "learning rate of means, times the Gaussian's own size")
    lr_quats: float = option(1.6e-3, "learning rate of quats")
    lr_scales: float = option(1.6e-2, "learning rate of log_scales")
    lr_opacities: float = option(0.1, "learning rate of opacity_logits")
    lr_sh0: float = option(4e-3, "learning rate of sh0")
    lr_shN: float = option(
        0.0,
        "learning rate of shN; 0 keeps SH degrees above 0 fixed, which costs 0.01 dB",
    )

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def paper(cls, **changes: Any) -> AdaptConfig:
        """The paper's form with its settings where it gives them, and the defaults elsewhere; then
        ``changes``.

        CLoD-GS section 3.3: lambda 1, sigma_d itself trained at 1e-2. Chosen here: half the default
        rates.
        """
        own: dict[str, Any] = {
            "form": "paper",
            "iters": 1600,
            "growth": "off",
            "lr_sigma": 1e-2,
            "lr_means": 0.03,
            "lr_quats": 8e-4,
            "lr_scales": 8e-3,
            "lr_opacities": 5e-2,
            "lr_sh0": 2e-3,
        }
        return cls(**own | changes)

    @classmethod
    def placed(cls, **changes: Any) -> AdaptConfig:
        """The defaults without photographs; then ``changes``.

        The dial goes up to the budgets that viewers of large scenes have, and counts fall faster,
        as near Gaussians, the checkpoint's own, reach farther (``training/far.py``).
        """
        own: dict[str, Any] = {"max_sv": PLACED_MAX_SV, "exponent": PLACED_EXPONENT}
        return cls(**own | changes)

    @property
    def steps(self) -> int:
        """``iters``, or the default for few training views."""
        return self.iters if self.iters is not None else self.for_views(0).steps

    def for_views(self, views: int) -> AdaptConfig:
        """A copy whose ``iters`` is set, by the number of training views and the batch where it is
        not.
        """
        if self.iters is not None:
            return self
        return replace(self, iters=max(round(max(STEPS, STEPS_PER_VIEW * views) / self.batch), 1))

    def attenuation(self, scene_distance: float) -> AttenuationConfig:
        """Settings of the equation in training; files have them in world units
        (``units.in_world_units``).
        """
        return AttenuationConfig(form=self.form, scene_distance=scene_distance, max_sv=self.max_sv)


def field_descriptions(config: Any) -> dict[str, str]:
    """Help text by field name."""
    return {f.name: f.metadata["help"] for f in fields(config)}
