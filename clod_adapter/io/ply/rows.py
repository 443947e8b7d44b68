"""The rows of a splat PLY, plain or packed: read, and which of them can be drawn."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from plyfile import PlyData

from clod_adapter._kernels import QUAT_MAX, QUAT_MIN
from clod_adapter.io.ply.body import check_length, read_elements
from clod_adapter.io.ply.columns import MASKS, SIGMA, column_map, dial_columns, read_table, sh_degree_of
from clod_adapter.io.ply.constants import constant_settings, read_constants
from clod_adapter.io.ply.header import Head, all_comments, described, read_head, stored_settings
from clod_adapter.io.ply.packed import NOTE, check_packed, is_packed, packed_elements, unpack
from clod_adapter.io.settings import Metadata, read_metadata
from clod_adapter.origin import Origin, relative

UNROTATED = "zero or not of a usable length"
ROWS = 4096  # in a block, which stays in the processor's cache


@dataclass(frozen=True)
class PlyRows:
    """A splat PLY as read.

    Attributes:
        head: of the file.
        vertex: ``[N]`` structured array, native byte order, with the columns of ``column_map(sh_degree)`` at least.
        sh_degree: 0 to 4.
        metadata: from comments, else from constant columns.
        notes: one line each.
        sha256: hex, of the bytes that were parsed.
    """

    head: Head
    vertex: np.ndarray
    sh_degree: int
    metadata: Metadata
    notes: tuple[str, ...]
    sha256: str

    @property
    def comments(self) -> tuple[str, ...]:
        return all_comments(self.head.ply)

    @property
    def activation_unknown(self) -> bool:
        """Whether opacities and scales may be activated already: not in files of this package, nor in packed ones."""
        return not self.metadata.described and not is_packed(self.head.ply)


def check_ply(path: Path) -> None:
    """Refuses, by its header, a file that is not a checkpoint.

    Raises:
        ClodError: it is not.
    """
    _elements(path, read_head(path).ply)


def open_ply(path: Path) -> bool:
    """Whether the header has a sigma_d; refuses damaged settings in it, and a file too short for its rows."""
    head = read_head(path)
    _elements(path, head.ply)
    check_length(path, head, path.stat().st_size)
    comments, dial = all_comments(head.ply), SIGMA in {column.name for column in head.ply["vertex"].properties}
    read_metadata(path, stored_settings(comments), dial=dial, described=described(comments))
    return dial


def read_ply(path: Path) -> PlyRows:
    """Reads a PLY once, from start to end; a packed one is unpacked.

    Raises:
        ClodError: not a checkpoint, damaged, or its settings are.
    """
    file = read_elements(path, _elements)
    header, comments, packed = file.head.ply, all_comments(file.head.ply), is_packed(file.head.ply)
    degree = check_packed(path, header) if packed else sh_degree_of(path, header)
    vertex = unpack(path, file.elements, degree) if packed else file.elements["vertex"]
    dial = SIGMA in (vertex.dtype.names or ())
    metadata = _metadata(path, comments, vertex, dial)
    return PlyRows(file.head, vertex, degree, metadata, (NOTE,) if packed else _not_kept(header), file.sha256)


def _elements(path: Path, header: PlyData) -> tuple[str, ...]:
    """The elements to read; refuses what is not a checkpoint."""
    if is_packed(header):
        check_packed(path, header)
        return packed_elements(header)
    sh_degree_of(path, header)
    return ("vertex",)


def _metadata(path: Path, comments: tuple[str, ...], vertex: np.ndarray, dial: bool) -> Metadata:
    """The settings of the comments, completed by those of the columns."""
    columns = constant_settings(read_constants(path, vertex)) if dial else {}
    ours = described(comments)
    values = columns | stored_settings(comments)
    values["attenuation"] = columns.get("attenuation", {}) | values["attenuation"]
    found = read_metadata(path, values, dial=dial, described=ours)
    if ours or not columns.get("attenuation"):
        return found
    names = ", ".join(columns["attenuation"])
    return replace(found, notes=(f"settings of the dial read from columns: {names}", *found.notes))


def _not_kept(header: PlyData) -> tuple[str, ...]:
    """A note on the parts of the file that an output will not have."""
    parts = [f"element {element.name}" for element in header if element.name != "vertex"]
    parts += ["obj_info"] if header.obj_info else []
    return (f"not carried over to outputs: {', '.join(parts)}",) if parts else ()


def usable_blocks(
    vertex: np.ndarray, sh_degree: int, origin: Origin, dropped: Counter[str]
) -> Iterator[tuple[slice, dict[str, np.ndarray], np.ndarray]]:
    """Blocks of rows: the slice, attributes ``[n, P]`` float32 with means relative to ``origin``, ``[n]`` bool usable.

    The attributes are those of ``column_map``, and the dial's and masks where the rows have them.

    Args:
        dropped: counts the other rows by reason.
    """
    names = vertex.dtype.names or ()
    groups = column_map(sh_degree) | dial_columns(names)
    groups |= {"masks": MASKS} if set(MASKS) <= set(names) else {}
    columns = [name for group in groups.values() for name in group]
    for start in range(0, len(vertex), ROWS):
        rows, at = slice(start, start + ROWS), 0
        table, values = read_table(vertex[rows], columns), dict[str, np.ndarray]()
        if any(origin):
            table[:, :3] = relative(vertex[rows], origin)
        for key, group in groups.items():
            values[key] = table[:, at : at + len(group)]
            at += len(group)
        yield rows, values, usable_rows(values, dropped)


def usable_rows(attributes: Mapping[str, np.ndarray], dropped: Counter[str]) -> np.ndarray:
    """``[N]`` bool, the Gaussians that can be drawn.

    Args:
        attributes: ``[N, ...]`` each; opacity_logits may be +inf.
        dropped: counts the others by the first rule that they break; 0 for the other rules.
    """
    count = len(attributes["means"])
    exists, finite = np.ones(count, bool), np.ones(count, bool)
    for name, values in attributes.items():
        usable = np.isfinite(values) | (values == np.inf) if name == "opacity_logits" else np.isfinite(values)
        finite &= usable.reshape(count, -1).all(1)
    if "masks" in attributes:  # sigmoid(first - second) >= 0.5; NaN is for the next rule
        exists = ~(attributes["masks"][:, 0] < attributes["masks"][:, 1])
    keep = np.ones(count, bool)
    for rule, reason in (
        (exists, "MaskGaussian existence probability below 0.5"),
        (finite, "a value is not finite"),
        (rotated(attributes["quats"]), f"rotation is {UNROTATED}"),
    ):
        dropped[reason] += int((keep & ~rule).sum())
        keep &= rule
    return keep


def rotated(quats: np.ndarray) -> np.ndarray:
    """``[N]`` bool, whether the quaternions ``[N, 4]`` float32 have a length that rasterizers can divide by."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt(np.square(quats).sum(1))
    return (length >= QUAT_MIN) & (length <= QUAT_MAX)
