"""The values of Gaussians between a file and memory: activations, filters, usable rows, the origin,
quantised levels.

Some trainers and tools store activated opacities or scales, which only their range shows.
Mip-Splatting (Yu et al., CVPR 2024, equation 9) stores a filter beside them, ``filter_3D``, that
its renderer applies.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
from scipy import special

from clod_adapter.config import SH_COUNTS, require
from clod_adapter.errors import ClodError
from clod_adapter.origin import Origin, origin_of, relative

if TYPE_CHECKING:
    from torch import Tensor

    from clod_adapter.gaussians import Gaussians

Activated = Literal["none", "opacity", "scales", "both"]
Arrays = dict[str, np.ndarray]
SIGMA = "sigma_d"
GROWTH = "growth_d"
FILTER_3D = "filter_3D"
MASKS = "masks"
# of far Gaussians, whose ``opacity`` is INVISIBLE: without the dial near ones alone are drawn
OPACITY = "opacity_d"
INVISIBLE = -20.0  # logit
ROWS = 4096  # in a block, which stays in the processor's cache
# why a Gaussian is dropped, by the first that applies
_RULES = (
    "MaskGaussian existence probability below 0.5",
    "a value is not finite",
    "rotation is zero or not of a usable length",
)
_FEW = 10  # Gaussians; fewer may have any range
# logit of 0.475; trainers keep fainter Gaussians, and files of |a| reach just below 0
_FAINTEST = -0.1
_TINY = float(np.finfo(np.float32).tiny)
_OPAQUE = 1 - 2.0**-24  # the largest float32 below 1


def dial_columns(names: Container[str]) -> dict[str, tuple[str, ...]]:
    """The dial's columns among ``names``, by attribute; growth_d without a sigma_d is another
    tool's.
    """
    if SIGMA not in names:
        return {}
    return {name: (name,) for name in (SIGMA, GROWTH, OPACITY) if name in names}


def degree_of(path: Path, rest: int) -> int:
    """The SH degree that this many ``f_rest_*`` make; rejects a number that makes none."""
    degrees = {3 * (count - 1): degree for degree, count in SH_COUNTS.items()}
    if rest in degrees:
        return degrees[rest]
    allowed = ", ".join(map(str, degrees))
    raise ClodError(
        f"{path}: {rest} f_rest_* properties fit no SH degree ({allowed} do); export the file again"
    )


class Prepared(NamedTuple):
    """Every row of a file as ``Gaussians`` take it."""

    arrays: Arrays  # of ``Gaussians.tensors``, float32, means relative to ``origin``
    keep: np.ndarray  # ``[N]`` bool, the rows that can be drawn
    origin: Origin  # world units
    activated: Activated  # what was taken as activated
    changes: list[str]  # to values that were not stored as logits and logarithms, one line each
    dropped: dict[str, int]  # the number of other rows by reason


def prepared(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    activated: Activated | None,
    at: Origin,
    origin: Origin | None,
) -> Prepared:
    """The values of ``Source.arrays``, whose means are relative to ``at``, as ``Gaussians`` take
    them: one at least.

    Args:
        activated: which values are activated, where their range allows both; None to reject then.
        origin: what the means are to be relative to; None for ``at``, or what ``origin_of`` finds
            where that is 0.
    """
    count = arrays["means"].shape[:1]
    coefficients = arrays["shN"].shape[1:2]
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,),
        "quats": (4,),
        "log_scales": (3,),
        "sh0": (1, 3),
        "shN": (*coefficients, 3),
        MASKS: (2,),
        FILTER_3D: (1,),
    }
    values: Arrays = {}
    for name, array in arrays.items():
        shape = (*count, *shapes.get(name, ()))
        if array.shape != shape:
            raise ClodError(
                f"{path}: {name} has shape {array.shape}, expected {shape}; export it again"
            )
        values[name] = array if name == "means" else np.ascontiguousarray(array, np.float32)
    if coefficients[0] + 1 not in SH_COUNTS.values():
        raise ClodError(
            f"{path}: shN has {coefficients[0]} coefficients, which fit no SH degree; export it"
            " again"
        )
    if OPACITY in values:
        far_logits = values.pop(OPACITY)
        values["opacity_logits"] = np.where(values[SIGMA] > 0, far_logits, values["opacity_logits"])
    was, changes = _as_logits(path, values, activated)
    if origin is None:
        origin = at if any(at) else origin_of(values["means"])
    values["means"] = np.ascontiguousarray(relative(values["means"], at, origin))
    keep, dropped = _usable(values)
    if not keep.any():
        why = "; ".join(dropped) or "it is empty"
        raise ClodError(
            f"{path}: no usable Gaussian in it, of {len(keep)} rows ({why}); export it again"
        )
    values.pop(MASKS, None)
    return Prepared(values, keep, origin, was, changes, dropped)


def _as_logits(
    path: Path, arrays: Arrays, activated: Activated | None
) -> tuple[Activated, list[str]]:
    """Turns arrays into logit opacities, logarithmic scales and no ``filter_3D``; what was
    activated, and a line for each change.
    """
    choices = get_args(Activated)
    require(
        activated in (None, *choices), "activated", repr(activated), f"one of {', '.join(choices)}"
    )
    ranges = in_question(arrays) if activated != "none" else {}
    if ranges and activated is None:
        where = " and ".join(
            f"{name} from {low:.4g} to {high:.4g}" for name, (low, high) in ranges.items()
        )
        raise ClodError(
            f"{path}: has {where}, which looks activated where a 3DGS file has logits (opacity) and"
            f" logarithms (scales); if it is, give --activated {choice_of(ranges)}, if not,"
            " --activated none (activated= in Python)"
        )
    activated_names = [name for name in ranges if activated in (name, "both")]
    notes = []
    if "opacity" in activated_names:
        # the absolute value is Taming-3DGS's activation
        opacity = np.abs(arrays["opacity_logits"].astype(np.float64))
        above = int((opacity > 1).sum())
        clipped = f" ({above} above 1 taken as 1)" if above else ""
        arrays["opacity_logits"] = logit(np.clip(opacity, _TINY, _OPAQUE)).astype(np.float32)
        notes.append(f"opacity taken as activated, and stored as logits{clipped}")
    if "scales" in activated_names:
        with np.errstate(invalid="ignore"):  # a NaN that signals
            scales = np.maximum(arrays["log_scales"].astype(np.float64), _TINY)
        arrays["log_scales"] = np.log(scales).astype(np.float32)
        notes.append("scales taken as activated, and stored as logarithms")
    if FILTER_3D in arrays:
        arrays["log_scales"], arrays["opacity_logits"] = _fused(arrays, arrays.pop(FILTER_3D))
        notes.append(
            "Mip-Splatting's filter_3D is fused into scale and opacity, and left out of outputs"
        )
    return choice_of(activated_names), notes


def in_question(arrays: Mapping[str, np.ndarray]) -> dict[str, tuple[float, float]]:
    """The ranges of "opacity" and of "scales", where it looks activated: at least ``_FEW`` values,
    none too small.
    """
    ranges: dict[str, tuple[float, float]] = {}
    opacity = arrays["opacity_logits"]
    candidates = [("opacity", opacity[:, None], _FAINTEST), ("scales", arrays["log_scales"], 0.0)]
    # Logits whose faint ones were pruned have more than half of their values above 1.
    if 2 * np.count_nonzero(opacity > 1) > len(opacity):
        candidates = candidates[1:]
    for name, values, least in candidates:
        finite = values[np.isfinite(values).all(1)]
        if len(finite) >= _FEW:
            low, high = float(finite.min()), float(finite.max())
            if low >= least and (low < high or high == 1):
                ranges[name] = low, high
    return ranges


def choice_of(names: Iterable[str]) -> Activated:
    """The choice of ``Activated`` for these values."""
    choices: list[Any] = [*names, "none"]
    return "both" if len(choices) == 3 else choices[0]


def _fused(arrays: Arrays, filter_3d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scales ``sqrt(s^2 + f^2)`` and opacities ``a sqrt(det(s^2) / det(s^2 + f^2))`` with the
    filter ``f``, in logs.
    """
    scales = arrays["log_scales"].astype(np.float64)
    logits = arrays["opacity_logits"][:, None].astype(np.float64)
    # values that are not finite stay so; their rows are dropped later
    with np.errstate(all="ignore"):
        size = np.log(np.abs(filter_3d.astype(np.float64)))
        wider = 0.5 * np.logaddexp(2 * scales, 2 * size)
        log_opacity = -np.logaddexp(0, -logits) + (scales - wider).sum(1, keepdims=True)
        # log(1 - a), of a near 1 from the logit itself where there is no filter
        fused = log_opacity - np.log(-np.expm1(log_opacity))
        fused = np.where(log_opacity < 0, fused, np.inf)
        unfiltered = (wider == scales).all(1, keepdims=True)
        opacity = np.where(unfiltered, logits, fused)[:, 0]
        return wider.astype(np.float32), opacity.astype(np.float32)


def _usable(arrays: Arrays) -> tuple[np.ndarray, dict[str, int]]:
    """``[N]`` bool, the Gaussians that can be drawn, and the number of the others by the first rule
    that they break.
    """
    from clod_adapter._kernels import QUAT_MAX, QUAT_MIN  # here: a header is checked without numba

    broken = np.zeros(len(arrays["means"]), np.uint8)  # the number of a rule
    for start in range(0, len(broken), ROWS):
        rules = broken[start : start + ROWS]
        block = {name: values[start : start + ROWS] for name, values in arrays.items()}
        with np.errstate(over="ignore", invalid="ignore"):
            length = np.sqrt(np.square(block["quats"]).sum(1))  # that rasterizers divide by
        rules[~((length >= QUAT_MIN) & (length <= QUAT_MAX))] = 3
        for name, values in block.items():
            usable = np.isfinite(values)
            if name in ("opacity_logits", OPACITY):
                usable |= values == np.inf
            if not usable.all():  # which is far faster than by rows
                rules[~usable.reshape(len(rules), -1).all(1)] = 2
        if MASKS in block:  # sigmoid(first - second) < 0.5
            rules[block[MASKS][:, 0] < block[MASKS][:, 1]] = 1
    dropped = {}
    for rule, reason in enumerate(_RULES, start=1):
        if count := int((broken == rule).sum()):
            dropped[reason] = count
    return broken == 0, dropped


def hidden(gaussians: Gaussians) -> dict[str, Tensor]:
    """``Gaussians.tensors`` as files store them: far ones are INVISIBLE, and OPACITY has their own
    logits.
    """
    tensors = {name: tensor.detach() for name, tensor in gaussians.tensors().items()}
    near = gaussians.near
    if near is not None:
        logits = tensors["opacity_logits"]
        tensors["opacity_logits"] = logits.masked_fill(~near, INVISIBLE)
        tensors[OPACITY] = logits.masked_fill(near, 0.0)
    return tensors


def arrays_of(path: Path, gaussians: Gaussians) -> Arrays:
    """The float32 arrays of ``hidden``; rejects values that ``load`` would drop."""
    arrays = {}
    for name, tensor in hidden(gaussians).items():
        arrays[name] = tensor.float().cpu().contiguous().numpy()
    if dropped := _usable(arrays)[1]:
        raise ClodError(f"{path}: {', '.join(dropped)}; drop such rows first, as load does")
    return arrays


def normalized(quats: np.ndarray) -> np.ndarray:
    """``[N, 4]`` float32 quaternions of unit length; none is zero."""
    wide = quats.astype(np.float64)
    lengths = np.linalg.norm(wide, axis=1, keepdims=True)
    return (wide / lengths).astype(np.float32)


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Opacities of logits, in float64; 1 for +inf."""
    return special.expit(logits.astype(np.float64))


def logit(opacities: np.ndarray) -> np.ndarray:
    """The inverse of ``sigmoid``."""
    return special.logit(opacities.astype(np.float64))


def bytes_of(values: np.ndarray) -> np.ndarray:
    """Levels of 0 to 255, rounded."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)
