"""PlayCanvas's compressed PLY, which SuperSplat, splat-transform and gsplat's exporter write: 32
bits an attribute.

Gaussians form chunks of 256. The element ``chunk`` stores the ranges of position, logarithmic scale
and, if newer, colour; ``vertex`` stores each Gaussian within the ranges of its chunk: position and
scale in 11, 10 and 11 bits, the three smaller components of the unit quaternion in 10 bits each and
the index of the largest in 2, colour and opacity in 8 bits each. The optional element ``sh`` stores
the higher harmonics in 8 bits, between -4 and 4.

Source: splat-transform 3.7, ``read-ply``; gsplat, ``exporter.splat2ply_bytes_compressed``.
"""

from collections.abc import Mapping
from itertools import product
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty

from clod_adapter.config import SH_COUNTS
from clod_adapter.errors import ClodError
from clod_adapter.io.values import Arrays, degree_of

BLOCK = 256
_BITS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_AXES = ("x", "y", "z")
_ENDS = ("min", "max")
_RANGES = tuple(f"{end}_{what}{axis}" for what, end, axis in product(("", "scale_"), _ENDS, _AXES))
_COLOURS = {f"{end}_{channel}" for end, channel in product(_ENDS, "rgb")}
NOTE = (
    "quantised: positions and scales in 11 bits a block, rotations in 10, colours, harmonics and"
    " opacities in 8"
)


def column_types(element: PlyElement) -> dict[str, str]:
    """The types of the properties by name; "list" of a list."""
    return {
        p.name: "list" if isinstance(p, PlyListProperty) else p.val_dtype
        for p in element.properties
    }


def is_packed(header: PlyData) -> bool:
    """Whether the vertices are packed."""
    if "vertex" not in header:
        return False
    return any(column.name.startswith("packed_") for column in header["vertex"].properties)


def check_packed(path: Path, header: PlyData) -> int:
    """The SH degree of such a file, by its header."""
    _require(path, header, "chunk", _RANGES, "f4")
    _require(path, header, "vertex", _BITS, "u4")
    coefficients = len(header["sh"].properties) if "sh" in header else 0
    if coefficients:
        _require(path, header, "sh", tuple(f"f_rest_{k}" for k in range(coefficients)), "u1")
    return degree_of(path, coefficients)


def unpack(path: Path, elements: Mapping[str, np.ndarray], degree: int) -> Arrays:
    """The attributes of the Gaussians of such a file, of the degree from ``check_packed``."""
    from clod_adapter.gaussians import SH_C0  # here: check_packed needs no torch

    chunks = elements["chunk"]
    packed = elements["vertex"]
    table = elements.get("sh")
    count = len(packed)
    bands = SH_COUNTS[degree] - 1
    needed = -(-count // BLOCK)
    if len(chunks) < needed:
        raise ClodError(
            f"{path}: is damaged: {count} Gaussians need {needed} chunks, not {len(chunks)}; copy"
            " it again"
        )
    if table is not None and len(table) != count:
        raise ClodError(
            f"{path}: is damaged: {len(table)} harmonics for {count} Gaussians; export it again"
        )

    def within(name: str, share: np.ndarray) -> np.ndarray:
        """Values at shares of the ranges of their blocks."""
        low, high = (chunks[f"{end}_{name}"][np.arange(count) // BLOCK] for end in _ENDS)
        return low * (1 - share) + high * share  # type: ignore[no-any-return]

    def vectors(prefix: str, bits: np.ndarray) -> np.ndarray:
        """``[N, 3]`` positions or scales."""
        shares = zip(_AXES, _shares(bits, (11, 10, 11)), strict=True)
        return np.stack([within(prefix + axis, share) for axis, share in shares], 1)

    # ranges that are not finite: their rows are dropped later
    with np.errstate(invalid="ignore", over="ignore"):
        means = vectors("", packed["packed_position"])
        log_scales = vectors("scale_", packed["packed_scale"])
        *colours, opacity = _shares(packed["packed_color"], (8, 8, 8, 8))
        if _COLOURS.issubset(chunks.dtype.names or ()):
            shares = zip("rgb", colours, strict=True)
            colours = [within(channel, share) for channel, share in shares]
    opacity = np.clip(opacity, 0.25 / 255, 254.75 / 255)  # so that no logit is infinite
    levels = np.arange(256, dtype=np.float32)
    shares_of_levels = (levels + 0.5) / 256
    shares_of_levels[0] = 0
    shares_of_levels[255] = 1
    steps = (shares_of_levels - 0.5) * 8
    harmonics = np.empty((count, bands, 3), np.float32)
    if table is not None:
        for k in range(3 * bands):  # channel by channel
            harmonics[:, k % bands, k // bands] = steps[table[f"f_rest_{k}"]]
    return {
        "means": means,
        "log_scales": log_scales,
        "sh0": (np.stack(colours, 1)[:, None] - 0.5) / SH_C0,
        "quats": _rotations(packed["packed_rotation"]),
        "opacity_logits": np.log(opacity / (1 - opacity)).astype(np.float32),
        "shN": harmonics,
    }


def _require(path: Path, header: PlyData, element: str, names: tuple[str, ...], kind: str) -> None:
    if element not in header:
        raise ClodError(
            f"{path}: is a compressed PLY without its element {element}; export it again"
        )
    types = column_types(header[element])
    if "list" in types.values():
        raise ClodError(
            f"{path}: element {element} of a compressed PLY has a list; export it again"
        )
    if absent := [name for name in names if types.get(name) != kind]:
        raise ClodError(
            f"{path}: is a compressed PLY, whose {element} has no {absent[0]} of type {kind};"
            " export again"
        )


def _shares(bits: np.ndarray, widths: tuple[int, ...]) -> list[np.ndarray]:
    """The parts of ``[N]`` uint32, highest first, each over the largest it can be: ``[N]`` in
    [0, 1].
    """
    shift = 32
    shares = []
    for width in widths:
        shift -= width
        largest = np.uint32((1 << width) - 1)
        level = (bits >> np.uint32(shift)) & largest
        shares.append(level.astype(np.float32) / largest)
    return shares


def _rotations(bits: np.ndarray) -> np.ndarray:
    """``[N, 4]`` float32 unit quaternions, wxyz."""
    shares = np.stack(_shares(bits << np.uint32(2), (10, 10, 10)))
    small = (shares - 0.5) * np.float32(np.sqrt(2))
    largest = np.sqrt(np.maximum(0, 1 - (small**2).sum(0)))
    missing = bits >> np.uint32(30)
    quats = np.empty((len(bits), 4), np.float32)
    for component in range(4):
        before = small[min(component, 2)]
        after = small[max(component - 1, 0)]
        stored = np.where(missing > component, before, after)
        quats[:, component] = np.where(missing == component, largest, stored)
    return quats
