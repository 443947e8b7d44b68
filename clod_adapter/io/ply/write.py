"""The rows of an output: the base's with changed values, constant columns, and last the dial's.

Rows are written in blocks that fit in the processor's cache, which is several times as fast, and a large file is never
held twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from plyfile import PlyData, PlyElement

from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.ply.columns import GROWTH, SIGMA, column_map, dial_columns, read_table
from clod_adapter.io.ply.constants import PREFIX
from clod_adapter.io.ply.rows import ROWS
from clod_adapter.origin import AXES, Origin, relative


def write_rows(
    file: BinaryIO, path: Path, gaussians: Gaussians, vertex: np.ndarray, origin: Origin, comments: list[str],
    constants: Mapping[str, float],
) -> None:  # fmt: skip
    """Writes header and rows of a binary little-endian PLY.

    Args:
        path: the name of the output, for messages.
        vertex: ``[N]`` the base's rows, of which ``gaussians`` are the Gaussians.
        origin: what the means are relative to; where it is not 0 coordinates become doubles.
        comments: of the element, in the header.
        constants: by name, float columns of one value each (``constants``); those of the base are dropped.

    Raises:
        ClodError: a new value is not finite.
    """
    dial = dial_columns(gaussians.tensors())
    gone = {SIGMA, GROWTH} if dial else dial_columns(vertex.dtype.names or ())  # growth_d alone is another tool's
    own = [name for name in vertex.dtype.names or () if name not in gone and not name.startswith(PREFIX)]
    kind = _dtype(vertex, own, origin, [*constants, *dial])
    one = np.broadcast_to(np.zeros((), kind), len(vertex))  # of which plyfile makes a header without the rows
    element = PlyElement.describe(one, "vertex", comments=comments)
    file.write(f"{PlyData([element], byte_order='<').header}\n".encode("ascii"))
    for block in _blocks(path, gaussians, vertex, own, origin, kind):
        for name, value in constants.items():
            block[name] = value
        file.write(block.astype(kind.newbyteorder("<"), copy=False).data)


def _dtype(vertex: np.ndarray, own: list[str], origin: Origin, added: list[str]) -> np.dtype:
    """Names, order and types of the base, but for coordinates that need more digits, as those far from 0 do."""
    columns = [(name, vertex.dtype[name]) for name in own]
    if any(origin):
        columns = [(name, np.dtype("f8") if name in AXES else kind) for name, kind in columns]
    return np.dtype(columns + [(name, np.dtype("f4")) for name in added])


def _blocks(
    path: Path, gaussians: Gaussians, vertex: np.ndarray, own: list[str], origin: Origin, kind: np.dtype
) -> Iterator[np.ndarray]:
    groups, dial = column_map(gaussians.sh_degree), dial_columns(gaussians.tensors())
    tensors = {name: tensor.detach() for name, tensor in gaussians.tensors().items()}
    for start in range(0, len(vertex), ROWS):
        rows = slice(start, start + ROWS)
        old, block = vertex[rows], np.empty(len(vertex[rows]), kind)
        for name in own:
            block[name] = old[name]
        for attribute, group in groups.items():
            new = _numpy(tensors[attribute][rows]).reshape(len(old), -1)
            _write_changes(path, attribute, group, new, old, origin, block)
        for name in dial:
            block[name] = _numpy(tensors[name][rows])
            if not np.isfinite(block[name]).all():
                instead = "a large number for no decay" if name == SIGMA else "0 for no growth"
                raise ClodError(f"{path}: {name} holds a value that is not finite; use {instead}")
        yield block


def _write_changes(
    path: Path, attribute: str, group: tuple[str, ...], new: np.ndarray, vertex: np.ndarray, origin: Origin,
    block: np.ndarray,
) -> None:  # fmt: skip
    """Puts the ``new [n, P]`` values of an attribute into the block where they are not the bits that were read."""
    old = relative(vertex, origin) if attribute == "means" else read_table(vertex, group)
    changed = new.view(np.uint32) != old.view(np.uint32)
    if not np.isfinite(new[changed]).all():
        raise ClodError(f"{path}: {attribute} holds a new value that is not finite; the tuning has diverged")
    for column in np.flatnonzero(changed.any(0)):
        rows = changed[:, column]
        shift = origin[column] if attribute == "means" else 0.0
        block[group[column]][rows] = new[rows, column].astype(np.float64) + shift if shift else new[rows, column]


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.float().cpu().numpy())
