"""Statistics of an inspection: ranges, shares and counts of a file's rows, in numpy, O(n log n)."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from scipy.special import expit

from clod_adapter.config import AttenuationConfig, ScreenFilter
from clod_adapter.io.values import GROWTH, SIGMA, Prepared
from clod_adapter.origin import Origin
from clod_adapter.quality_table import QualityTable

QUANTILES = (0, 0.01, 0.5, 0.99, 1)
NEEDLE = 10.0  # a Gaussian this many times as long as its second axis
FAR = 10.0  # times the distance from the median position within which nine tenths lie
FAINT = 1 / 255  # opacity that rasterizers leave out


@dataclass(frozen=True)
class Spread:
    """Quantiles of values: the least, the middle 98 %, the median, the greatest."""

    least: float
    low: float
    median: float
    high: float
    greatest: float

    @classmethod
    def of(cls, values: np.ndarray) -> Spread:
        """Summarize a non-empty array."""
        return cls(*np.quantile(values, QUANTILES).tolist())

    def moved(self, by: float) -> Spread:
        """The spread of the values plus ``by``."""
        return Spread(*(value + by for value in astuple(self)))


@dataclass(frozen=True)
class Dial:
    """The settings of a file with a dial."""

    attenuation: AttenuationConfig
    calibration: QualityTable | None


@dataclass(frozen=True)
class Splat:
    """A file of Gaussians, and the statistics of its usable rows."""

    total: int  # rows of the file
    count: int  # usable ones
    dropped: dict[str, int]  # the others, by the reason
    used_sh_degree: int  # the highest with a coefficient that is not 0
    position: tuple[Spread, Spread, Spread]
    scale: Spread  # of all three standard deviations
    opacity: Spread
    needles: float  # share more than NEEDLE times as long as along their second axis
    infinite_opacity: int  # opacity = +inf
    doubles: int  # rows that stand exactly where an earlier one does
    far: int  # FAR times as far from the median position as nine tenths are
    giant: int  # largest standard deviation over half the diagonal of the middle 98 %
    fainter_than_visible: float  # share
    sigma: Spread | None
    growth: Spread | None
    sh_degree: int
    encoding: str  # of a PLY
    columns: tuple[tuple[str, str], ...]  # the properties of a PLY in its order, with their types
    extra: tuple[str, ...]  # properties without a meaning here, copied to outputs unchanged
    comments: tuple[str, ...]  # of the header, without ours
    origin: Origin
    dial: Dial | None
    screen_filter: ScreenFilter

    @property
    def dial_columns(self) -> str:
        """The columns of the dial, of a file that has one."""
        return "sigma_d" if self.growth is None else "sigma_d and growth_d"


def values_of(prepared: Prepared) -> dict[str, Any]:
    """The fields of ``Splat`` up to ``growth``, of a file's rows, of which one is usable at
    least.
    """
    keep = prepared.keep
    columns = {name: array[keep] for name, array in prepared.arrays.items() if name != "shN"}
    means = columns["means"]
    logits = columns["opacity_logits"].astype(np.float64)
    opacities = expit(logits)
    with np.errstate(over="ignore"):
        scales = np.sort(np.exp(columns["log_scales"].astype(np.float64))).T
    position = [Spread.of(axis) for axis in means.T]
    # In float64, in which the squares of all float32 numbers fit.
    middle = np.array([spread.median for spread in position])
    distance = np.linalg.norm(means - middle, axis=1)
    diagonal = float(np.linalg.norm([spread.high - spread.low for spread in position]))
    used = prepared.arrays["shN"].any((0, 2), where=keep[:, None, None])
    highest = int(np.max(np.flatnonzero(used) + 1, initial=0))
    return dict(
        total=len(keep),
        count=int(keep.sum()),
        dropped=prepared.dropped,
        position=tuple(map(Spread.moved, position, prepared.origin)),
        used_sh_degree=math.isqrt(highest),
        scale=Spread.of(scales.ravel()),
        opacity=Spread.of(opacities),
        needles=float((scales[2] > NEEDLE * scales[1]).mean()),
        infinite_opacity=int(np.isposinf(logits).sum()),
        doubles=len(means) - len(np.unique(means, axis=0)),
        far=int((distance > FAR * np.quantile(distance, 0.9)).sum()),
        giant=int((scales[2] > diagonal / 2).sum()) if diagonal > 0 else 0,
        fainter_than_visible=float((opacities < FAINT).mean()),
        sigma=Spread.of(columns[SIGMA]) if SIGMA in columns else None,
        growth=Spread.of(columns[GROWTH]) if GROWTH in columns else None,
    )
