"""Counts of errors for stability_equation.py, by quantity and dtype."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import exact
from exact import DTYPES, Array

import numpy as np
import torch

NAIVE = 1e3  # units of eps from which on the paper's formula has failed
REASONS = ("nan", "infinite", "zero", "inaccurate")


@dataclass
class Tally:
    """What was found of one quantity in one dtype."""

    quantity: str
    dtype: str
    unit: str  # the dtype whose eps errors are counted in
    bound: str
    part: str = "equation"
    points: int = 0
    nan: int = 0
    failed: int = 0  # past the bound, or not finite where it should be
    worst: float = 0.0
    worst_of_bound: float = 0.0  # the largest share of the bound that is used
    worst_at: dict[str, float] = field(default_factory=dict)
    naive: dict[str, int] = field(default_factory=lambda: dict.fromkeys(REASONS, 0))

    def add(
        self, got: Array, want: Array, allowed: Array | float, at: dict[str, Any], naive: Array | None = None,
        sure: Array | bool = True,
    ) -> None:  # fmt: skip
        """``want`` is wide; ``at`` says where the arrays' entries are; ``sure`` which of them have a right answer."""
        info, size = torch.finfo(DTYPES[self.unit]), np.abs(want)
        with np.errstate(all="ignore"):
            off = np.abs(got - want)
            error = np.where(size >= info.tiny, off / (info.eps * size), off > info.tiny)
            # What overflows may be infinite or, of slopes, 0 by their definition.
            error = np.where(size > info.max, np.where(np.isinf(got) | (got == 0), 0, np.inf), error)
            error = np.where(sure, np.where(np.isnan(off), np.where(got == want, 0, np.inf), error), 0)
            error = np.where((size < info.tiny) & (error > 0), np.inf, error)
        share, i = error / allowed, int(np.argmax(error))
        self.points += len(want)
        self.nan += int(np.isnan(got).sum())
        self.failed += int((~(share <= 1)).sum())
        self.worst_of_bound = max(self.worst_of_bound, float(np.max(share)))
        if error[i] >= self.worst:
            self.worst = float(error[i])
            self.worst_at = {key: float(value if np.isscalar(value) else value[i]) for key, value in at.items()}
        if naive is not None:
            self._add_naive(naive, np.where(sure, size, 0), want)

    def _add_naive(self, naive: Array, size: Array, want: Array) -> None:
        info = torch.finfo(DTYPES[self.dtype])
        normal = (size >= info.tiny) & (size <= info.max) & np.isfinite(naive)
        with np.errstate(all="ignore"):
            far = np.abs(naive - want) > NAIVE * info.eps * size
        found = (
            np.isnan(naive), np.isinf(naive) & (size <= info.max), normal & (naive == 0), normal & (naive != 0) & far
        )  # fmt: skip
        for reason, where in zip(REASONS, found, strict=True):
            self.naive[reason] += int(where.sum())

    def row(self) -> dict[str, Any]:
        """JSON-able, with shares of the points for the paper's formula."""
        shares = {f"naive_{reason}": count / self.points for reason, count in self.naive.items()}
        rest = {key: value for key, value in asdict(self).items() if key != "naive"}
        return {**rest, **shares, "naive_failed": sum(shares.values())}


class Tallies:
    """The tallies of one dtype, made on first use."""

    def __init__(self, dtype: str) -> None:
        self.dtype, self.found = dtype, dict[str, Tally]()
        self.rounding = dtype if dtype.endswith("16") else exact.computed_in(dtype)  # of gradients
        self.wide = dtype == "float64"
        self.info = torch.finfo(DTYPES[exact.computed_in(dtype)])

    def of(self, quantity: str, bound: str, gradient: bool = False) -> Tally:
        unit = self.rounding if gradient else exact.computed_in(self.dtype)
        return self.found.setdefault(quantity, Tally(quantity, self.dtype, unit, bound))
