"""The usable Gaussians of a file in any format, before its settings are applied."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from clod_adapter.config import ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import PLY, Model, format_of, read_model
from clod_adapter.io.ply.columns import column_map, dial_columns, in_shape, read_table, rows_of
from clod_adapter.io.ply.rows import PlyRows, read_ply, usable_blocks, usable_rows
from clod_adapter.io.ply.values import Activated, as_stored_by_inria
from clod_adapter.io.screen_filter import implied_filter, tagged
from clod_adapter.io.settings import Metadata
from clod_adapter.origin import Origin, origin_of, relative


class Content(NamedTuple):
    """The usable Gaussians of a file.

    Attributes:
        metadata: the settings of the file.
        arrays: of ``Gaussians.tensors``, float32, means relative to ``origin``.
        vertex, comments, fingerprint, origin: of ``checkpoint.Checkpoint``.
        changes: to values that were not stored as logits and logarithms, one line each.
        dropped: the number of rows by reason, of those that are not usable.
        implied_filter: by other programs' comments and columns.
        notes: what the reader noticed, one line each, besides the notes of the metadata.
    """

    metadata: Metadata
    arrays: dict[str, np.ndarray]
    vertex: np.ndarray
    comments: tuple[str, ...]
    fingerprint: str
    origin: Origin
    changes: list[str]
    dropped: Counter[str]
    implied_filter: ScreenFilter
    notes: tuple[str, ...]

    def row_notes(self) -> list[str]:
        """What was changed and dropped, and values that are out of the ordinary, one line each."""
        notes = [*self.changes, *_dropped_notes(self.dropped, len(self.vertex) + self.dropped.total())]
        if opaque := int((self.arrays["opacity_logits"] == np.inf).sum()):
            notes.append(f"{opaque} Gaussians have opacity = +inf and are taken as fully opaque")
        if any(self.origin):
            where = ", ".join(f"{value:.10g}" for value in self.origin)
            notes.append(f"far from 0: read relative to ({where}); outputs have x, y, z as double")
        return notes


def read_content(path: Path, activated: Activated | None, origin: Origin | None) -> Content:
    """Reads a file; arguments and errors as ``checkpoint.load``."""
    if format_of(path) is PLY:
        return _ply_content(path, read_ply(path), activated, origin)
    return _model_content(path, read_model(path), activated, origin)


def _ply_content(path: Path, rows: PlyRows, activated: Activated | None, origin: Origin | None) -> Content:
    implied = implied_filter(rows.comments, rows.vertex.dtype.names or ())
    vertex, was, changes = as_stored_by_inria(path, rows.vertex, activated if rows.activation_unknown else "none")
    origin, dropped = origin_of(vertex) if origin is None else origin, Counter[str]()
    groups = column_map(rows.sh_degree) | dial_columns(vertex.dtype.names or ())
    values = {key: np.empty((len(vertex), len(group)), np.float32) for key, group in groups.items()}
    keep = np.empty(len(vertex), bool)
    for block, found, usable in usable_blocks(vertex, rows.sh_degree, origin, dropped):
        keep[block] = usable
        for key in groups:
            values[key][block] = found[key]
    arrays, vertex = _usable(path, in_shape(values), vertex, keep, dropped)
    return Content(
        rows.metadata, arrays, vertex, rows.comments, _fingerprint(was, rows.sha256), origin, changes, dropped,
        implied, rows.notes,
    )  # fmt: skip


def _model_content(path: Path, model: Model, activated: Activated | None, origin: Origin | None) -> Content:
    metadata, arrays = model.metadata, {name: tensor.numpy() for name, tensor in model.gaussians.tensors().items()}
    vertex, dropped = rows_of(arrays, metadata.origin), Counter[str]()
    vertex, was, changes = as_stored_by_inria(path, vertex, activated if model.activation_unknown else "none")
    if changes:
        arrays["opacity_logits"], scales = vertex["opacity"].copy(), column_map(0)["log_scales"]
        arrays["log_scales"] = read_table(vertex, scales)
    if origin is None:
        origin = metadata.origin if any(metadata.origin) else origin_of(vertex)
    if origin != metadata.origin:
        arrays["means"] = relative(vertex, origin)
    arrays, vertex = _usable(path, arrays, vertex, usable_rows(arrays, dropped), dropped)
    about = ["".join(c if c.isascii() and c.isprintable() else "?" for c in line) for line in metadata.about]
    implied = model.gaussians.screen_filter
    comments = tuple(tagged(about, implied))
    return Content(
        metadata, arrays, vertex, comments, _fingerprint(was, model.sha256), origin, changes, dropped, implied,
        model.notes,
    )  # fmt: skip


def _usable(
    path: Path, arrays: dict[str, np.ndarray], vertex: np.ndarray, keep: np.ndarray, dropped: Counter[str]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The arrays and rows to keep; refuses a file with none."""
    if not keep.any():
        reasons = "; ".join(_dropped_notes(dropped, len(keep))) or "it has 0 rows"
        raise ClodError(f"{path}: no usable Gaussian in it ({reasons}); export it again")
    if keep.all():
        return arrays, vertex
    return {name: array[keep] for name, array in arrays.items()}, vertex[keep]


def _dropped_notes(dropped: Counter[str], total: int) -> list[str]:
    return [f"{lost} of {total} Gaussians dropped: {reason}" for reason, lost in dropped.items() if lost]


def _fingerprint(activated: Activated, sha256: str) -> str:
    return sha256 if activated == "none" else f"{activated}:{sha256}"
