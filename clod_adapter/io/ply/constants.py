"""Settings as constant columns, for tools that keep the columns of a PLY and drop its comments.

A setting that is not the default is stored in a float column whose name begins with ``clod_``, before ``sigma_d``.
``reference_distance`` is stored so where there is a ``growth_d``, which is measured in it.
``max_sv``, the end of the trained range, has no column: reading sigma_d does not need it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.settings import FILTER

PREFIX = "clod_"
TAU, EPS, HARD, QUANTILE, MAX = "clod_tau", "clod_eps", "clod_hard_cut", "clod_quantile", "clod_max"
REFERENCE = "clod_reference_distance"
VARIANCE, COMPENSATE = "clod_screen_variance", "clod_compensate"
DIGITS = 6  # decimal digits that every float32 holds


def dial_constants(config: AttenuationConfig | None, growth: bool) -> dict[str, float]:
    """The columns, by name, of settings that are not the defaults; sigma_d in world units.

    Args:
        growth: whether there is a growth_d.
    """
    if config is None:
        return {}
    usual = AttenuationConfig()
    found = {TAU: config.tau} if config.tau != usual.tau else {}
    found |= {EPS: config.eps} if config.eps != usual.eps else {}
    found |= {HARD: 1.0} if config.cut == "hard" else {}
    found |= {QUANTILE: config.quantile} if config.normalizer == "quantile" else {}
    found |= {REFERENCE: config.reference_distance} if growth and config.reference_distance else {}
    return found | ({MAX: 1.0} if config.normalizer == "max" else {})


def filter_constants(screen_filter: ScreenFilter) -> dict[str, float]:
    """The columns, by name, of a screen-space filter that is not the classic one."""
    found = {VARIANCE: screen_filter.variance} if screen_filter.variance != CLASSIC.variance else {}
    return found | ({COMPENSATE: 1.0} if screen_filter.compensate else {})


def constant_settings(constants: Mapping[str, float]) -> dict[str, Any]:
    """The settings in the columns, as ``settings.read_metadata`` takes them; the inverse of the two functions above."""
    found: dict[str, Any] = {}
    for column, name in ((TAU, "tau"), (EPS, "eps"), (QUANTILE, "quantile"), (REFERENCE, "reference_distance")):
        if column in constants:
            found[name] = constants[column]
    if constants.get(HARD):
        found["cut"] = "hard"
    if QUANTILE in constants or constants.get(MAX):
        found["normalizer"] = "max" if constants.get(MAX) else "quantile"
    values: dict[str, Any] = {"attenuation": found} if found else {}
    if VARIANCE in constants or COMPENSATE in constants:
        variance = constants.get(VARIANCE, CLASSIC.variance)
        values[FILTER] = {"variance": variance, "compensate": bool(constants.get(COMPENSATE))}
    return values


def read_constants(path: Path, vertex: np.ndarray) -> dict[str, float]:
    """The value of each column whose name begins with ``clod_``, by ``simplest``.

    Args:
        vertex: ``[N]`` rows of the file.

    Raises:
        ClodError: a column has more than one value, as in a merge of files with different settings.
    """
    found = {}
    for name in vertex.dtype.names or ():
        if name.startswith(PREFIX) and len(vertex):
            values = vertex[name]
            if not (values == values[0]).all():
                raise ClodError(
                    f"{path}: property {name} must be one value for all rows and has several, so files of different "
                    "settings were merged; give one of them"
                )
            found[name] = simplest(values[0])
    return found


def simplest(value: Any) -> float:
    """The simplest number that float32 rounds to ``value``, which is the number that was written.

    The shortest decimal; where that has more than six digits, 1/n if that is one for a whole n (1/255).
    """
    narrow = np.float32(value)
    shortest = float(str(narrow))
    if np.float32(f"{shortest:.{DIGITS}g}") == narrow or not 0 < shortest < 1:
        return shortest
    fraction = 1 / round(1 / shortest)
    return fraction if np.float32(fraction) == narrow else shortest
