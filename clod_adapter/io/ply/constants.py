"""Settings as columns of one value each, for the tools that keep the columns of a PLY and drop its comments.

A setting that is not the default stands in a float column whose name begins with ``clod_``, before ``sigma_d``: all
that is needed to read sigma_d right. ``max_sv``, which only says how far the dial was trained, has none.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError

PREFIX = "clod_"
TAU, EPS, HARD, QUANTILE, MAX = "clod_tau", "clod_eps", "clod_hard_cut", "clod_quantile", "clod_max"
VARIANCE, COMPENSATE = "clod_screen_variance", "clod_compensate"
DIGITS = 6  # decimal digits that any float32 holds


def dial_constants(config: AttenuationConfig | None) -> dict[str, float]:
    """The columns, by name, of the settings of a dial in world units that are not the defaults."""
    if config is None:
        return {}
    usual = AttenuationConfig()
    found = {TAU: config.tau} if config.tau != usual.tau else {}
    found |= {EPS: config.eps} if config.eps != usual.eps else {}
    found |= {HARD: 1.0} if config.cut == "hard" else {}
    found |= {QUANTILE: config.quantile} if config.normalizer == "quantile" else {}
    return found | ({MAX: 1.0} if config.normalizer == "max" else {})


def dial_settings(constants: Mapping[str, float]) -> dict[str, Any]:
    """The inverse: fields of ``AttenuationConfig``, as far as the columns tell; others are left out."""
    found: dict[str, Any] = {}
    for column, name in ((TAU, "tau"), (EPS, "eps"), (QUANTILE, "quantile")):
        if column in constants:
            found[name] = constants[column]
    if constants.get(HARD):
        found["cut"] = "hard"
    if QUANTILE in constants or constants.get(MAX):
        found["normalizer"] = "max" if constants.get(MAX) else "quantile"
    return found


def filter_constants(screen_filter: ScreenFilter) -> dict[str, float]:
    """The columns, by name, of a screen-space filter, as far as it is not the usual one."""
    found = {VARIANCE: screen_filter.variance} if screen_filter.variance != CLASSIC.variance else {}
    return found | ({COMPENSATE: 1.0} if screen_filter.compensate else {})


def filter_of(constants: Mapping[str, float]) -> ScreenFilter | None:
    """The inverse; None where no column tells.

    Raises:
        ClodError: a value is out of range.
    """
    if VARIANCE not in constants and COMPENSATE not in constants:
        return None
    variance = constants.get(VARIANCE, CLASSIC.variance)
    return ScreenFilter(variance=variance, compensate=bool(constants.get(COMPENSATE)))


def read_constants(path: Path, vertex: np.ndarray) -> dict[str, float]:
    """The value of each column whose name begins with ``clod_``, as ``simplest`` has it.

    Args:
        vertex: ``[N]`` rows as they are in the file, N > 0.

    Raises:
        ClodError: a column has more than one value: rows with different settings were put together.
    """
    found = {}
    for name in vertex.dtype.names or ():
        if name.startswith(PREFIX) and len(vertex):
            values = vertex[name]
            if not (values == values[0]).all():
                raise ClodError(
                    f"{path}: property {name} must be one value for all rows and has several, so files of different "
                    "settings were put together; give one of them"
                )
            found[name] = simplest(values[0])
    return found


def simplest(value: Any) -> float:
    """The simplest number that float32 rounds to ``value``: what was meant, and so read as it was written.

    The shortest decimal; where that has more than six digits, 1/n if that is one for a whole n (1/255).
    """
    narrow = np.float32(value)
    shortest = float(str(narrow))
    if np.float32(f"{shortest:.{DIGITS}g}") == narrow or not 0 < shortest < 1:
        return shortest
    fraction = 1 / round(1 / shortest)
    return fraction if np.float32(fraction) == narrow else shortest
