"""Statistics of an inspection: ranges, shares and counts of a file's rows, in numpy, O(n log n)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clod_adapter.config import SH_COUNTS
from clod_adapter.io.values import GROWTH, SIGMA, Prepared

BULK = (0.01, 0.99)  # quantiles that bound the middle 98 %
NEEDLE = 10.0  # a Gaussian this many times as long as its second axis
FAR = 10.0  # times the distance from the median position within which nine tenths lie
FAINT = 1 / 255  # opacity that rasterizers leave out


@dataclass(frozen=True)
class Spread:
    """Of some values: the least, the middle 98 %, the median, the greatest."""

    least: float
    low: float
    median: float
    high: float
    greatest: float

    @classmethod
    def of(cls, values: np.ndarray) -> Spread:
        """Of at least one value."""
        with np.errstate(invalid="ignore"):  # between two infinite ones
            low, median, high = (float(value) for value in np.quantile(values, (BULK[0], 0.5, BULK[1])))
        return cls(float(values.min()), low, median, high, float(values.max()))


@dataclass(frozen=True)
class Values:
    """Statistics of the usable rows.

    Attributes:
        total: rows of the file.
        count: usable ones; the others by ``dropped``: the reason, and how many.
        used_sh_degree: the highest with a coefficient that is not 0.
        position: of x, y and z, world units.
        scale: of all three standard deviations, world units; ``largest_scale`` of each Gaussian's largest.
        opacity: activated; ``opacity_quartiles`` its 25 %, 50 % and 75 %.
        needles: share more than NEEDLE times as long as along their second axis.
        infinite_opacity: rows with opacity = +inf.
        not_unit: share whose stored quaternion is longer or shorter than 1 by a thousandth and more.
        doubles: rows that stand exactly where an earlier one does.
        far: rows FAR times as far from the median position as nine tenths are.
        giant: rows whose largest standard deviation is over half the diagonal of the middle 98 %.
        fainter_than_tau, fainter_than_visible: shares whose opacity is below ``values_of``'s ``tau``, and FAINT.
        sigma, growth: of sigma_d and growth_d, where they are there.
    """

    total: int
    count: int
    dropped: dict[str, int]
    used_sh_degree: int
    position: tuple[Spread, Spread, Spread]
    scale: Spread
    largest_scale: Spread
    opacity: Spread
    opacity_quartiles: tuple[float, float, float]
    needles: float
    infinite_opacity: int
    not_unit: float
    doubles: int
    far: int
    giant: int
    fainter_than_tau: float
    fainter_than_visible: float
    sigma: Spread | None
    growth: Spread | None


def values_of(found: Prepared, tau: float) -> Values:
    """The statistics of a file's rows, of which one is usable at least."""
    keep, dropped = found.keep, {reason: gone for reason, gone in found.dropped.items() if gone}
    columns = {name: np.ascontiguousarray(array[keep].T) for name, array in found.arrays.items() if name != "shN"}
    means, logits = columns["means"], columns["opacity_logits"].astype(np.float64)
    with np.errstate(over="ignore"):
        scales = np.sort(np.exp(columns["log_scales"].astype(np.float64)), 0)
        opacities = 1 / (1 + np.exp(-logits))
    position = [Spread.of(axis) for axis in means]
    # In float64, in which the squares of all float32 numbers fit.
    middle = np.array([[spread.median] for spread in position])
    distance = np.linalg.norm(means.astype(np.float64) - middle, axis=0)
    diagonal = float(np.linalg.norm([spread.high - spread.low for spread in position]))
    length = np.linalg.norm(columns["quats"].astype(np.float64), axis=0)
    x, y, z = (_moved(spread, by) for spread, by in zip(position, found.origin, strict=True))
    q1, q2, q3 = (float(value) for value in np.quantile(opacities, (0.25, 0.5, 0.75)))
    return Values(
        total=len(keep), count=int(keep.sum()), dropped=dropped, position=(x, y, z),
        used_sh_degree=_used_degree(found.arrays["shN"], keep),
        scale=Spread.of(scales.ravel()), largest_scale=Spread.of(scales[2]), opacity=Spread.of(opacities),
        opacity_quartiles=(q1, q2, q3), needles=float((scales[2] > NEEDLE * scales[1]).mean()),
        infinite_opacity=int(np.isposinf(logits).sum()),
        not_unit=float((np.abs(length - 1) > 1e-3).mean()), doubles=_doubles(means),
        far=int((distance > FAR * np.quantile(distance, 0.9)).sum()),
        giant=int((scales[2] > diagonal / 2).sum()) if diagonal > 0 else 0,
        fainter_than_tau=float((opacities < tau).mean()), fainter_than_visible=float((opacities < FAINT).mean()),
        sigma=Spread.of(columns[SIGMA]) if SIGMA in columns else None,
        growth=Spread.of(columns[GROWTH]) if GROWTH in columns else None,
    )  # fmt: skip


def _used_degree(harmonics: np.ndarray, keep: np.ndarray) -> int:
    """The highest SH degree with a coefficient that is not 0."""
    used = [k + 1 for k in range(harmonics.shape[1]) if harmonics[:, k][keep].any()]
    return next(degree for degree, count in SH_COUNTS.items() if count > max(used, default=0))


def _doubles(means: np.ndarray) -> int:
    """How many of ``[3, N]`` positions are exactly an earlier one."""
    bits = np.ascontiguousarray(means + np.float32(0)).view(np.uint32).astype(np.uint64)  # + 0: no -0
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    with np.errstate(over="ignore"):
        keys = (bits * factors[:, None]).sum(0, dtype=np.uint64)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    alike = np.flatnonzero(keys[1:] == keys[:-1])  # keys are alike by chance too, if hardly ever
    return int((means[:, order[alike + 1]] == means[:, order[alike]]).all(0).sum())


def _moved(spread: Spread, by: float) -> Spread:
    return Spread(*(value + by for value in (spread.least, spread.low, spread.median, spread.high, spread.greatest)))
