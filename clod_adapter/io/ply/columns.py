"""The columns of a splat PLY: what they are called and which files are not plain splats.

Reader and writer share the map of names.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Mapping
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyListProperty

from clod_adapter.config import SH_COUNTS
from clod_adapter.errors import ClodError
from clod_adapter.origin import AXES, NOWHERE, Origin

SIGMA, GROWTH = "sigma_d", "growth_d"
MASKS = ("masks_0", "masks_1")


def column_map(sh_degree: int) -> dict[str, tuple[str, ...]]:
    """The columns of each Gaussians attribute, in the order of its flattened values.

    ``f_rest`` is channel-major in the file: ``f_rest_{c * (K-1) + k}`` is ``shN[:, k, c]``.
    """
    bands = SH_COUNTS[sh_degree] - 1
    return {
        "means": ("x", "y", "z"),
        "quats": tuple(f"rot_{i}" for i in range(4)),
        "log_scales": tuple(f"scale_{i}" for i in range(3)),
        "opacity_logits": ("opacity",),
        "sh0": tuple(f"f_dc_{c}" for c in range(3)),
        "shN": tuple(f"f_rest_{c * bands + k}" for k in range(bands) for c in range(3)),
    }


def dial_columns(names: Container[str]) -> dict[str, tuple[str, ...]]:
    """The dial's columns among ``names``, as in ``column_map``; growth_d without a sigma_d is another tool's."""
    return {name: (name,) for name in (SIGMA, GROWTH) if name in names} if SIGMA in names else {}


def rows_of(attributes: Mapping[str, np.ndarray], origin: Origin = NOWHERE) -> np.ndarray:
    """``[N]`` rows in Inria's layout of the values of each Gaussians attribute, ``[N, ...]``; the dial last.

    Args:
        origin: what the means are relative to, world units; where it is not 0, x, y and z are doubles.
    """
    count, coefficients = len(attributes["means"]), attributes["shN"].shape[1] + 1
    sh_degree = next(degree for degree, number in SH_COUNTS.items() if number == coefficients)
    dial = dial_columns(attributes)
    vertex = np.zeros(count, inria_dtype(sh_degree, origin, dial))
    for attribute, group in (column_map(sh_degree) | dial).items():
        flat = attributes[attribute].reshape(count, len(group))
        for k, column in enumerate(group):
            shift = origin[k] if attribute == "means" else 0.0
            vertex[column] = flat[:, k].astype(np.float64) + shift if shift else flat[:, k]
    return vertex


def in_shape(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The attributes' columns ``[N, P]`` in the shapes of ``Gaussians``, as views."""
    arrays = dict(values)
    for name in ("opacity_logits", SIGMA, GROWTH):
        if name in arrays:
            arrays[name] = arrays[name][:, 0]
    for name in ("sh0", "shN"):
        arrays[name] = arrays[name].reshape(len(arrays[name]), arrays[name].shape[1] // 3, 3)
    return arrays


def inria_dtype(sh_degree: int, origin: Origin = NOWHERE, dial: Iterable[str] = ()) -> np.dtype:
    """The rows of the file that Inria's trainer writes, normals included, and the dial's columns.

    Positions with an origin are doubles.
    """
    groups = column_map(sh_degree)
    rest = sorted(groups["shN"], key=lambda name: int(name.rsplit("_", 1)[1]))  # the map lists them by coefficient
    names = [*groups["means"], "nx", "ny", "nz", *groups["sh0"], *rest]
    names += [*groups["opacity_logits"], *groups["log_scales"], *groups["quats"], *dial]
    return np.dtype([(name, "f8" if any(origin) and name in AXES else "f4") for name in names])


def read_table(vertex: np.ndarray, names: Iterable[str]) -> np.ndarray:
    """``[N, P]`` float32 copy of the named columns; values beyond float32's range become infinite."""
    names = list(names)
    table = np.empty((len(vertex), len(names)), np.float32)
    rows = 4096  # a block of rows stays in cache while its columns are picked out, which is 8 times faster
    with np.errstate(over="ignore", invalid="ignore"):  # invalid: a NaN that signals
        for start in range(0, len(vertex), rows):
            block = vertex[start : start + rows]
            for column, name in enumerate(names):
                table[start : start + rows, column] = block[name]
    return table


def sh_degree_of(path: Path, header: PlyData) -> int:
    """The SH degree of a file with plain Gaussians, by its header.

    Raises:
        ClodError: the file holds something else, or a needed column is missing or of a wrong type.
    """
    if "vertex" not in header:
        found = ", ".join(element.name for element in header) or "none"
        raise ClodError(f"{path}: has no vertex element (elements: {found}); give a splat in Inria's 3DGS layout")
    properties = header["vertex"].properties
    types = {p.name: "list" if isinstance(p, PlyListProperty) else p.val_dtype for p in properties}
    _refuse_foreign(path, set(types))
    degree = degree_of(path, sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in types))
    for name in [name for group in column_map(degree).values() for name in group]:
        if name not in types:
            raise ClodError(f"{path}: property {name} is missing; export the file again in Inria's 3DGS layout")
        if types[name] not in ("f4", "f8"):
            raise ClodError(f"{path}: property {name} is not float or double; export the file again with float columns")
    lists = [name for name, kind in types.items() if kind == "list"]
    if lists:
        raise ClodError(f"{path}: property {lists[0]} is a list, which splat viewers cannot read; remove it")
    return degree


def degree_of(path: Path, rest: int) -> int:
    """The SH degree that this many ``f_rest_*`` make.

    Raises:
        ClodError: they make none.
    """
    degrees = {3 * (count - 1): degree for degree, count in SH_COUNTS.items()}
    if rest not in degrees:
        wanted = ", ".join(map(str, degrees))
        raise ClodError(f"{path}: {rest} f_rest_* properties fit no SH degree ({wanted} do); export the file again")
    return degrees[rest]


def _refuse_foreign(path: Path, names: set[str]) -> None:
    if anchors := sorted(name for name in names if re.fullmatch(r"f_offset_\d+|f_anchor_feat_\d+", name)):
        raise ClodError(
            f"{path}: property {anchors[0]} is of a Scaffold-GS or Octree-GS file: anchors from which a network makes "
            "Gaussians per view; use a checkpoint of 3DGS or of a method that keeps plain Gaussians"
        )
    if not names & {"f_dc_0", "scale_0"}:
        raise ClodError(
            f"{path}: properties f_dc_0 and scale_0 are missing, so this is a mesh or a point cloud; "
            "give the point_cloud.ply that a 3DGS trainer writes"
        )
    if {"scale_0", "scale_1"} <= names and "scale_2" not in names:
        raise ClodError(
            f"{path}: property scale_2 is missing, so this is a 2DGS file of flat disks; use a 3DGS checkpoint"
        )
