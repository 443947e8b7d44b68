"""Gaussians as numpy arrays, checked before writing and after reading; conversions of their values."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from clod_adapter.config import CLASSIC
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.io.atomic import check_target
from clod_adapter.io.ply.rows import UNROTATED, rotated
from clod_adapter.io.settings import Metadata
from clod_adapter.io.sniff import refuse_irregular

_TINY = float(np.finfo(np.float32).tiny)
# The axes in which each spherical harmonic is odd, in the order of ``Gaussians.shN``.
_ODD = (
    "y", "z", "x",
    "xy", "yz", "", "xz", "",
    "y", "xyz", "y", "z", "x", "z", "x",
    "xy", "yz", "xy", "yz", "", "xz", "", "xz", "",
)  # fmt: skip


def arrays_of(path: Path, gaussians: Gaussians) -> dict[str, np.ndarray]:
    """The float32 arrays of ``Gaussians.tensors``, checked for writing.

    Raises:
        ClodError: there are none, a value is not finite (opacity = +inf aside), a rotation is unusable, or the target
            cannot be written.
    """
    check_target(path)
    if len(gaussians) == 0:
        raise ClodError(f"{path}: there are no Gaussians to write, and no reader takes a file without any")
    arrays = {
        name: np.ascontiguousarray(tensor.detach().float().cpu().numpy())
        for name, tensor in gaussians.tensors().items()
    }
    for name, array in arrays.items():
        finite = np.isfinite(array) | (array == np.inf) if name == "opacity_logits" else np.isfinite(array)
        if not finite.all():
            raise ClodError(f"{path}: {name} holds a value that is not finite; drop such rows first, as load does")
    if not rotated(arrays["quats"]).all():
        raise ClodError(f"{path}: a rotation is {UNROTATED}; drop such rows first, as load does")
    return arrays


def gaussians_of(path: Path, arrays: Mapping[str, np.ndarray], metadata: Metadata) -> Gaussians:
    """Gaussians of the arrays, as float32.

    Raises:
        ClodError: there are none, or the arrays do not fit together.
    """
    tensors = {name: torch.from_numpy(np.array(array, np.float32, order="C")) for name, array in arrays.items()}
    if not all(tensor.ndim and len(tensor) for tensor in tensors.values()):
        raise ClodError(f"{path}: has no Gaussians in it; export it again")
    screen_filter = metadata.screen_filter or CLASSIC
    try:
        return Gaussians(**tensors, attenuation=metadata.attenuation, screen_filter=screen_filter)
    except ClodError as error:
        raise ClodError(f"{path}: {error}; export it again") from error


def half_turn(arrays: Mapping[str, np.ndarray], axis: str) -> dict[str, np.ndarray]:
    """The Gaussians under a half turn about ``x`` or ``z``, between axes with y down and with y up.

    Exact, and its own inverse. With ``P`` the turn (two signs), means become ``P mu``, rotations ``P R P``, which
    gives the same ellipsoids, and harmonics change sign where they are odd in an odd number of the axes that flip.
    """
    signs = {name: np.float32(1 if name == axis else -1) for name in "xyz"}
    harmonics = [np.prod([signs[name] for name in odd]) for odd in _ODD]
    bands = arrays["shN"].shape[1]
    return {
        **arrays, "means": arrays["means"] * np.array([*signs.values()], np.float32),
        "quats": arrays["quats"] * np.array([1, *signs.values()], np.float32),
        "shN": arrays["shN"] * np.array(harmonics[:bands], np.float32)[:, None],
    }  # fmt: skip


def normalized(quats: np.ndarray) -> np.ndarray:
    """``[N, 4]`` float32 quaternions of unit length; none is zero."""
    wide = quats.astype(np.float64)
    return (wide / np.linalg.norm(wide, axis=1, keepdims=True)).astype(np.float32)


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Opacities of logits, in float64; 1 for +inf."""
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-logits.astype(np.float64)))


def logit(opacities: np.ndarray) -> np.ndarray:
    """The inverse of ``sigmoid``."""
    wide = opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(wide) - np.log1p(-wide)


def scales_of(path: Path, log_scales: np.ndarray) -> np.ndarray:
    """Standard deviations of their logarithms, float32.

    Raises:
        ClodError: one is beyond float32's range.
    """
    with np.errstate(over="ignore"):
        scales = np.exp(log_scales)
    if not np.isfinite(scales).all():
        raise ClodError(f"{path}: a scale is beyond float32's range; drop such rows first")
    return scales


def logs_of(scales: np.ndarray) -> np.ndarray:
    """The inverse of ``scales_of``, in float64; values of 0 or less are read as float32's smallest number."""
    with np.errstate(invalid="ignore"):  # a NaN that signals
        return np.log(np.maximum(scales.astype(np.float64), _TINY))


def colours_of(sh0: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """``[N, 4]`` uint8 RGBA of SH degree 0."""
    colours = 0.5 + SH_C0 * sh0.reshape(-1, 3).astype(np.float64)
    return bytes_of(255 * np.concatenate([colours, opacities[:, None]], 1))


def bytes_of(values: np.ndarray) -> np.ndarray:
    """Rounded to 0 to 255."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def logits_of_bytes(levels: np.ndarray) -> np.ndarray:
    """Logits of opacities in 255ths; the first and last level are read as a quarter of a level from 0 and 1.

    So no logit is infinite.
    """
    return logit(np.clip(levels.astype(np.float64), 0.25, 254.75) / 255)


def sha256_of(data: bytes) -> str:
    """SHA-256, hex."""
    return hashlib.sha256(data).hexdigest()


def read_whole(path: Path) -> bytes:
    """A file's bytes.

    Raises:
        ClodError: it cannot be read.
    """
    try:
        refuse_irregular(path)
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name that holds a NUL
        raise ClodError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}); check the path") from error
