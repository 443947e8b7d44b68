"""PLY files of Gaussians, by plyfile: headers, and reading.

Any property order, byte order or ascii.
"""

from __future__ import annotations

import io
import re
import warnings
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from plyfile import PlyData, PlyElement, PlyListProperty

from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.io import file_formats
from clod_adapter.io.ply_layout import column_map, ply_metadata
from clod_adapter.io.ply_layout import write as write
from clod_adapter.io.settings import Source, of_another_method
from clod_adapter.io.values import (
    FILTER_3D,
    GROWTH,
    MASKS,
    OPACITY,
    SIGMA,
    Arrays,
    degree_of,
    dial_columns,
)

MASK_COLUMNS = ("masks_0", "masks_1")
HEADER_LIMIT = 1 << 20  # bytes
_LONGEST = 1 << 20  # characters of a row of text
# prefixes by CloudCompare and by 3dgsconverter
_PREFIXED = rb"(?<=[\r\n])(property[ \t]+\w+[ \t]+)(?:scal(?:ar)?_)+"
UNPREFIXED = (
    "saved by CloudCompare: its properties are read, and written, without the prefix scalar_"
)


class Head(NamedTuple):
    """A PLY header."""

    ply: PlyData  # elements, properties and comments; every element has 0 rows
    # each with the number of rows that the header states
    elements: tuple[tuple[PlyElement, int], ...]
    text: bytes  # as plyfile reads it, names without CloudCompare's prefix
    size: int  # bytes of the header in the file; the data starts there
    comments: tuple[str, ...]  # the file's, then each element's
    notes: tuple[str, ...]  # what was changed, one line each


def read_head(path: Path, data: bytes | None = None) -> Head:
    """The header of a file, or of its bytes, alone: nothing is parsed or allocated of the rows that
    it states.
    """
    start = file_formats.read_bytes(path, HEADER_LIMIT) if data is None else data[:HEADER_LIMIT]
    if not re.match(rb"ply\r?\n|ply\r", start):
        file_formats.reject(
            path, start, "is not a PLY file; convert it to a .ply in Inria's 3DGS layout first"
        )
    end = re.search(rb"[\r\n]end_header(\r?\n|\r)", start)
    if end is None:
        raise ValueError(f"the PLY header has no end in its first {len(start):,} bytes")

    def in_ascii(line: re.Match[bytes]) -> bytes:
        return re.sub(rb"[^\t\x20-\x7e]", b"?", line[0])

    text = re.sub(rb"(?<=[\r\n])(comment|obj_info)\b[^\r\n]+", in_ascii, start[: end.end()])
    notes: tuple[str, ...] = ()
    if re.search(_PREFIXED + rb"scale_0\b", text) and b" scale_0" not in text:
        text = re.sub(_PREFIXED, rb"\g<1>", text)
        notes = (UNPREFIXED,)
    header = re.sub(rb"\r\n?", b"\n", text)
    if re.search(rb"[^\t\n\x20-\x7e]", header):
        raise ValueError("the PLY header has a name that is not printable ASCII")
    counts = re.findall(rb"(?m)^[ \t]*element[ \t]+\S+[ \t]+(\d{1,20})[ \t]*$", header)
    header = re.sub(rb"(?m)^([ \t]*element[ \t]+\S+[ \t]+)\d{1,20}[ \t]*$", rb"\g<1>0", header)
    with rejected_if_damaged(path, "the PLY header is damaged"):
        ply = PlyData.read(io.BytesIO(header), mmap=False)
        if len(counts) != len(ply.elements):
            raise ValueError("a row count is not a number")
    elements = tuple(zip(ply, map(int, counts), strict=True))
    comments = tuple(chain(ply.comments, *(element.comments for element in ply)))
    return Head(ply, elements, text, end.end(), comments, notes)


def has_dial(path: Path) -> bool:
    """Whether the header has a sigma_d; rejects another kind, damaged settings, and too few bytes
    for its rows.
    """
    head = read_head(path)
    sh_degree_of(path, head.ply)
    _check_length(head, path.stat().st_size)
    dial = SIGMA in {column.name for column in head.ply["vertex"].properties}
    ply_metadata(path, head.comments, dial=dial)
    return dial


def read(path: Path, data: bytes) -> Source:
    """Reads a PLY; nothing is allocated for rows that its length does not have."""
    head = read_head(path, data)
    degree = sh_degree_of(path, head.ply)
    _check_length(head, len(data))
    rows = _vertices(data, head)
    notes = [*head.notes, *of_another_method(rows.dtype.names or ())]
    arrays = _arrays(rows, degree)
    metadata = ply_metadata(path, head.comments, rows, dial=SIGMA in arrays)
    lost = [f"element {element.name}" for element in head.ply if element.name != "vertex"]
    if head.ply.obj_info:
        lost.append("obj_info")
    if lost:
        notes.append(f"not carried over to outputs: {', '.join(lost)}")
    return Source(arrays, metadata, tuple(notes), head.comments, not metadata.described, rows, head)


def _vertices(data: bytes, head: Head) -> np.ndarray:
    """The rows of the Gaussians, native byte order, of all bytes of a file.

    plyfile reads text, and binary files with lists before the Gaussians, row by row.
    """
    at = head.size
    for element, count in head.elements:
        if head.ply.text or "list" in column_types(element).values():
            break
        kind = np.dtype(element.dtype(head.ply.byte_order))
        if element.name == "vertex":
            rows = np.frombuffer(data, kind, count, at)
            return rows.astype(kind.newbyteorder("="), copy=False)
        at += count * kind.itemsize
    if head.ply.text:
        lines = io.TextIOWrapper(io.BytesIO(data), "latin-1")  # CR ends a line too
        if any(len(line) > _LONGEST for line in lines):  # the parser copies a row several times
            raise ValueError(f"a row of more than {_LONGEST:,} characters")
    with warnings.catch_warnings(), np.errstate(over="ignore"):
        warnings.simplefilter("ignore")  # of text that is beyond float32's range
        # a copy if it was changed
        content = data if data.startswith(head.text) else head.text + data[head.size :]
        rows = PlyData.read(io.BytesIO(content))["vertex"].data
    return rows.astype(rows.dtype.newbyteorder("="), copy=False)


def _arrays(rows: np.ndarray, sh_degree: int) -> Arrays:
    """The columns of ``column_map``, of the dial, of masks and filter, by attribute; doubles of the
    means stay.
    """
    names = rows.dtype.names or ()
    groups = column_map(sh_degree) | dial_columns(names)
    groups |= {MASKS: MASK_COLUMNS, FILTER_3D: (FILTER_3D,)}
    arrays: Arrays = {"shN": np.zeros((len(rows), 0), np.float32)}  # of degree 0
    with np.errstate(over="ignore", invalid="ignore"):  # invalid: a NaN that signals
        for key, group in groups.items():
            if group and set(group) <= set(names):
                doubles = any(rows.dtype[name].itemsize == 8 for name in group)
                kind = np.dtype("f8" if key == "means" and doubles else "f4")
                arrays[key] = structured_to_unstructured(rows[list(group)], kind, copy=True)
    for name in ("opacity_logits", SIGMA, GROWTH, OPACITY):
        if name in arrays:
            arrays[name] = arrays[name][:, 0]
    arrays["sh0"] = arrays["sh0"].reshape(-1, 1, 3)
    arrays["shN"] = arrays["shN"].reshape(len(rows), len(groups["shN"]) // 3, 3)
    return arrays


def _check_length(head: Head, length: int) -> None:
    """Rejects a file that is too short for the least bytes that the rows of its header take."""
    text = head.ply.text
    least = head.size - text
    for element, count in head.elements:
        columns = element.properties
        if text:  # a digit, and a space or line end, which the last line may lack
            least += count * max(1, 2 * len(columns))
            continue
        for column in columns:
            is_list = isinstance(column, PlyListProperty)
            kind = column.len_dtype if is_list else column.val_dtype
            least += count * np.dtype(kind).itemsize
    if least > length:
        rows = ", ".join(f"{count} of {element.name}" for element, count in head.elements)
        raise ValueError(
            f"it is truncated: its header claims {rows}, {least} bytes, and the file has {length}"
        )


def column_types(element: PlyElement) -> dict[str, str]:
    """The types of the properties by name; "list" of a list."""
    types = {}
    for column in element.properties:
        types[column.name] = "list" if isinstance(column, PlyListProperty) else column.val_dtype
    return types


def sh_degree_of(path: Path, header: PlyData) -> int:
    """The SH degree of a checkpoint with this header; rejects something else, and missing
    columns.
    """
    if "vertex" not in header:
        names = ", ".join(element.name for element in header) or "none"
        raise ClodError(
            f"{path}: has no vertex element (elements: {names}); give a splat in Inria's 3DGS"
            " layout"
        )
    types = column_types(header["vertex"])
    if any(name.startswith("packed_") for name in types):
        raise ClodError(
            f"{path}: is a compressed PLY; call it {path.stem}.compressed.ply, as which it is read"
            " through splat-transform"
        )
    anchors = [name for name in types if re.fullmatch(r"f_offset_\d+|f_anchor_feat_\d+", name)]
    if anchors:
        raise ClodError(
            f"{path}: property {min(anchors)} is of Scaffold-GS or Octree-GS, where a network makes"
            " Gaussians for each view; use a checkpoint of 3DGS or of a method that keeps plain"
            " Gaussians"
        )
    if not types.keys() & {"f_dc_0", "scale_0"}:
        raise ClodError(
            f"{path}: properties f_dc_0 and scale_0 are missing, so this is a mesh or a point"
            " cloud; give the point_cloud.ply that a 3DGS trainer writes"
        )
    if {"scale_0", "scale_1"} <= types.keys() and "scale_2" not in types:
        raise ClodError(
            f"{path}: has no property scale_2, so this is a 2DGS file of flat disks; use a 3DGS"
            " checkpoint"
        )
    if "red" in types and "f_dc_0" not in types:
        raise ClodError(
            f"{path}: has colours in the place of f_dc_0, f_dc_1, f_dc_2; export it again by"
            " ns-export gaussian-splat --ply-color-mode sh_coeffs"
        )
    higher = [name for name in types if re.fullmatch(r"f_rest_\d+", name)]
    degree = degree_of(path, len(higher))
    for name in chain(*column_map(degree).values()):
        if types.get(name) not in ("f4", "f8"):
            fault = "is not float or double" if name in types else "is missing"
            raise ClodError(
                f"{path}: property {name} {fault}; export the file again in Inria's 3DGS layout"
            )
    if lists := [name for name, kind in types.items() if kind == "list"]:
        raise ClodError(
            f"{path}: property {lists[0]} is a list, which splat viewers cannot read; remove it"
        )
    return degree
