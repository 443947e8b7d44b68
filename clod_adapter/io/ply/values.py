"""Converts values that are not Inria's logits and logarithms to these on reading.

Some trainers and tools store activated opacities or scales, which only their range shows. Mip-Splatting (Yu et al.,
CVPR 2024, equation 9) stores a filter beside them, ``filter_3D``, that its renderer applies.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from clod_adapter.errors import ClodError
from clod_adapter.io.ply.columns import column_map, read_table

Activated = Literal["none", "opacity", "scales", "both"]
FILTER = "filter_3D"
_OPACITY, _SCALES = ("opacity",), column_map(0)["log_scales"]
_FEW = 10  # Gaussians; fewer may have any range
_FAINTEST = -0.1  # logit of 0.475; trainers keep fainter Gaussians, and files of |a| reach just below 0
_TINY = float(np.finfo(np.float32).tiny)
_OPAQUE = 1 - 2.0**-24  # the largest float32 below 1


def as_stored_by_inria(
    path: Path, vertex: np.ndarray, activated: Activated | None
) -> tuple[np.ndarray, Activated, list[str]]:
    """Rows with logit opacities, logarithmic scales and no ``filter_3D``; what was activated; a line for each change.

    Args:
        vertex: ``[N]`` as read; modified.
        activated: which values are activated, where their range allows both; None to refuse then.

    Raises:
        ClodError: the range allows both and ``activated`` is None, or ``activated`` is not a valid choice.
    """
    if activated is not None and activated not in get_args(Activated):
        raise ClodError(f"activated is {activated!r}, it must be one of {', '.join(get_args(Activated))}")
    found = in_question(vertex)
    if found and activated is None:
        raise ClodError(f"{path}: {_question(found)}")
    taken = [name for name in found if activated in (name, "both")]
    notes = []
    if "opacity" in taken:
        notes.append(_take_logits(vertex))
    if "scales" in taken:
        _put(vertex, _SCALES, np.log(np.maximum(_table(vertex, _SCALES), _TINY)))
        notes.append("scales taken as activated, and stored as logarithms")
    if FILTER in (vertex.dtype.names or ()):
        vertex = _fused(vertex)
        notes.append("Mip-Splatting's filter_3D is fused into scale and opacity, and left out of outputs")
    return vertex, choice_of(taken), notes


def in_question(vertex: np.ndarray) -> dict[str, tuple[float, float]]:
    """The range of "opacity" and of "scales", where it looks activated."""
    opacity, scales = _table(vertex, _OPACITY), _table(vertex, _SCALES)
    found = {}
    # At most half of the values above 1: not true of logits whose faint ones were pruned.
    if (extent := _range(opacity, _FAINTEST)) and np.nanmedian(opacity) <= 1:
        found["opacity"] = extent
    if extent := _range(scales, 0.0):
        found["scales"] = extent
    return found


def choice_of(found: Iterable[str]) -> Activated:
    """The choice of ``Activated`` for these values."""
    kinds = set(found)
    return "both" if len(kinds) == 2 else "opacity" if "opacity" in kinds else "scales" if kinds else "none"


def _range(values: np.ndarray, least: float) -> tuple[float, float] | None:
    """The smallest and the largest, if none is below ``least`` and there are at least ``_FEW``."""
    values = values[np.isfinite(values).all(1)]
    if len(values) < _FEW:
        return None
    low, high = float(values.min()), float(values.max())
    return (low, high) if low >= least and (low < high or high == 1) else None


def _question(found: dict[str, tuple[float, float]]) -> str:
    ranges = " and ".join(f"{name} from {low:.4g} to {high:.4g}" for name, (low, high) in found.items())
    choice = choice_of(found)
    return (
        f"has {ranges}, which looks like activated values where a 3DGS file has logits (opacity) and logarithms "
        f"(scales); if they are, give --activated {choice}, if not, --activated none (activated= in Python)"
    )


def _take_logits(vertex: np.ndarray) -> str:
    """Makes opacities ``a`` into ``log(|a| / (1 - |a|))``: the absolute value is Taming-3DGS's activation."""
    opacity = np.abs(_table(vertex, _OPACITY))
    above = int((opacity > 1).sum())
    opacity = np.clip(opacity, _TINY, _OPAQUE)
    _put(vertex, _OPACITY, np.log(opacity) - np.log1p(-opacity))
    return "opacity taken as activated, and stored as logits" + (f" ({above} above 1 taken as 1)" if above else "")


def _fused(vertex: np.ndarray) -> np.ndarray:
    """With the filter ``f``: scales ``sqrt(s^2 + f^2)``, opacity ``a sqrt(det(s^2) / det(s^2 + f^2))``, in logs."""
    scales, logits = _table(vertex, _SCALES), _table(vertex, _OPACITY)
    with np.errstate(all="ignore"):  # values that are not finite stay so; their rows are dropped later
        size = np.log(np.abs(_table(vertex, (FILTER,))))
        wider = 0.5 * np.logaddexp(2 * scales, 2 * size)
        log_opacity = -np.logaddexp(0, -logits) + (scales - wider).sum(1, keepdims=True)
        # log(1 - a), of a near 1 from the logit itself where there is no filter
        fused = np.where(log_opacity < 0, log_opacity - np.log(-np.expm1(log_opacity)), np.inf)
        unfiltered = (wider == scales).all(1, keepdims=True)
    _put(vertex, _SCALES, wider)
    _put(vertex, _OPACITY, np.where(unfiltered, logits, fused))
    kept = [name for name in vertex.dtype.names or () if name != FILTER]
    rows = np.empty(len(vertex), [(name, vertex.dtype[name]) for name in kept])
    for name in kept:
        rows[name] = vertex[name]
    return rows


def _table(vertex: np.ndarray, columns: tuple[str, ...]) -> np.ndarray:
    """``[N, P]`` float64 of what the reader sees, which is float32."""
    with np.errstate(invalid="ignore"):  # a NaN that signals
        return read_table(vertex, columns).astype(np.float64)


def _put(vertex: np.ndarray, columns: tuple[str, ...], values: np.ndarray) -> None:
    """Overwrites the columns with ``[N, P]`` values."""
    with np.errstate(over="ignore"):
        for k, name in enumerate(columns):
            vertex[name] = values[:, k]
