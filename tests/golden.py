"""Makes ``golden.json``: values of the equation in float64, for tests of implementations in other languages.

    python tests/golden.py

A row has the inputs opacity, sigma, distance, scale, eps, tau, soft, and the results ``faded``, the attenuated opacity
``a''``, and ``drawn``, the opacity for the rasterizer. Inputs are float32 numbers, written in full. A float32
implementation passes if for every row ``|result - drawn| <= tolerance faded``, and 0 where drawn is 0.

A row of ``scale_rows`` has the inputs growth, distance, scale, reach, and the result ``factor``, by which the three
scales are multiplied. A float32 implementation passes if ``|result - factor| <= tolerance factor``.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.equation.extinction import extinction_scale
from clod_adapter.equation.growth import growth_factors

FILE = Path(__file__).parents[1] / "clod_adapter" / "integrations" / "shaders" / "golden.json"
COLUMNS = ("opacity", "sigma", "distance", "scale", "eps", "tau", "soft", "faded", "drawn")
SCALE_COLUMNS = ("growth", "distance", "scale", "reach", "factor")
TOLERANCE = 3e-5  # float32 rounding times the steepest slope and the largest exponent, with a margin
TAU, EPS = 0.02, 1e-8


def rows() -> list[list[Any]]:
    """The inputs: ordinary and extreme values, then both sides of each culling threshold."""
    ordinary = itertools.product((0.03, 0.4, 1.0), (0.2, 1.5), (0.05, 1.2), (0.0, 0.5, 1.0, 2.5, 7.0), (EPS,), (TAU,))
    extreme = itertools.chain(
        itertools.product((0.0, 1.0), (-1.0, 0.0, 1e30), (0.0,), (1.0, 100.0), (0.0, EPS), (TAU,)),
        itertools.product((0.9,), (-1.0, 0.0, 1e-25, 1e-6, 1e30), (1e-25, 1e-6, 1e4), (40.0,), (0.0, EPS), (1 / 255,)),
        itertools.product((0.5,), (0.01, 5.0), (1e-3, 1.0), (30.0, 100.0), (0.0, 1e-2), (1e-6,)),
        [(1.0, 1.0, 0.0, 1.0, EPS, 0.5)],  # a'' = 2 tau s; at tau s the last bits of two logarithms would decide
    )
    found = [list(map(_float32, row)) for row in itertools.chain(ordinary, extreme)]
    for opacity, sigma, distance in itertools.product((0.3, 0.999), (0.1, 0.8, 4.0), (0.0, 1.2)):
        culled = _culled_at(opacity, sigma, distance)
        shares = (0.5, 0.9, 0.999, 1.001)  # of the dial value that culls it; fading begins between the first two
        dials = [scale for scale in (culled * share for share in shares) if scale <= 100]
        found += [list(map(_float32, (opacity, sigma, distance, scale, EPS, TAU))) for scale in dials]
    return [[*row, soft] for row in found for soft in (False, True)]


def scale_rows() -> list[list[float]]:
    """The inputs: ordinary values on both sides of the reach, then products and factors that overflow."""
    ordinary = itertools.product((-1.0, 0.0, 0.3, 0.75, 3.0), (0.2, 1.0, 4.2), (0.0, 1.0, 2.5, 7.0), (1.0, 3.8))
    extreme = itertools.chain(
        itertools.product((-1.0, 0.0, 0.75), (0.0, 1e-30, 1e30), (1.0, 100.0), (1e-4, 1e4)),
        itertools.product((-1e4, 1e4), (0.0, 1e3), (40.0,), (1.0,)),
    )
    return [list(map(_float32, row)) for row in itertools.chain(ordinary, extreme)]


def golden() -> dict[str, Any]:
    """The file's contents."""
    finished = [[*row, *_results(row)] for row in rows()]
    factors = [[*row, _factor(*row)] for row in scale_rows()]
    return {
        "columns": COLUMNS, "tolerance": TOLERANCE, "rows": finished,
        "scale_columns": SCALE_COLUMNS, "scale_rows": factors,
    }  # fmt: skip


def _results(row: list[Any]) -> tuple[float, float]:
    *values, scale, eps, tau, soft = row
    config = AttenuationConfig(tau=tau, eps=eps, cut="soft" if soft else "hard", max_sv=1)
    opacity, sigma, distance = (torch.tensor([value], dtype=torch.float64) for value in values)
    result = attenuate(opacity, sigma, distance, scale, config, activated=True)
    return float(result.opacities), float(result.drawn)


def _factor(growth: float, distance: float, scale: float, reach: float) -> float:
    growth_d, d = (torch.tensor([value], dtype=torch.float64) for value in (growth, distance))
    return float(growth_factors(growth_d, d, scale, reach))


def _culled_at(opacity: float, sigma: float, distance: float) -> float:
    config = AttenuationConfig(tau=_float32(TAU), eps=_float32(EPS), max_sv=1)
    values = [torch.tensor([_float32(value)], dtype=torch.float64) for value in (opacity, sigma, distance)]
    return float(extinction_scale(values[0].logit(), values[1], values[2], config))


def _float32(value: float) -> float:
    return float(np.float32(value))


def text() -> str:
    """The file's text, one row per line."""
    parts = []
    for name, value in golden().items():
        lines = ",\n".join(f"  {json.dumps(row)}" for row in value) if name.endswith("rows") else ""
        parts.append(f'"{name}": ' + (f"[\n{lines}\n]" if lines else json.dumps(value)))
    return f"{{{', '.join(parts)}}}\n"


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
