"""The exponents that are fitted are those that the rows have."""

from __future__ import annotations

import math
from typing import Any

import pytest
import scaling_rows as measured

SIZES = (measured.FLOOR, *measured.SIZES)


def test_exponents() -> None:
    """Of powers; of a sum with a constant, which is subtracted before the fit."""
    for power in (0.5, 1.0, 2.0):
        assert measured.exponent([(n, 3 * n**power) for n in SIZES]) == pytest.approx(power)
    assert math.isnan(measured.exponent([(1.0, 1.0)]))
    fitted, last = measured.growth([(n, 2.0 + 1e-6 * n) for n in SIZES])
    assert fitted == pytest.approx(1, abs=0.01)
    assert 0.5 < last < 0.9  # the constant is in it


def row(count: int) -> dict[str, Any]:
    return {"series": "count", "command": "eval", "gaussians": count, "seconds": 1.0, "peak_bytes": 4e8 + 500 * count}


def test_bytes_a_gaussian_are_the_slope_between_the_largest_sizes() -> None:
    each, rest = measured.bytes_a_gaussian([row(n) for n in SIZES], "eval")
    assert each == pytest.approx(500)
    assert rest == pytest.approx(4e8)
