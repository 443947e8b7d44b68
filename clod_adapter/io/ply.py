"""Checkpoints: a tolerant reader, and a strict writer of the extended PLY."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plyfile import PlyData, PlyElement

from clod_adapter.calibration import Calibration
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.hook import Hook
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.origin import AXES, NOWHERE, Origin, origin_of, relative
from clod_adapter.io.ply_columns import MASKS, SIGMA, column_map, inria_dtype, read_table
from clod_adapter.io.ply_header import read_attenuation, read_calibration, write_comments
from clod_adapter.io.ply_values import Activated, as_stored_by_inria
from clod_adapter.io.readers import read_rows
from clod_adapter.io.usable import row_rules


@dataclass(frozen=True)
class Checkpoint:
    """A file as read: its Gaussians, and what the writer needs to give the rest back untouched.

    Attributes:
        gaussians: the usable Gaussians, float32; with sigma_d and attenuation if the file is extended.
        vertex: ``[N]`` structured array, the same rows with every column of the file, in file order
            and type, native byte order; what was activated or filtered is not any more.
        comments: the header's comments.
        notes: what was dropped or noticed, one line each, for the report.
        fingerprint: SHA-256 of the file's bytes, hex; before it and a colon, what was taken as activated.
        path: where it was read from.
        calibration: what its dial values keep, cost and take, if the file says so.
        origin: ``[3]`` what the means are relative to, world units: not 0 only for a scene far from 0, whose
            photographs are to be read relative to it too (``load_scene``). Outputs are in the file's own coordinates.
    """

    gaussians: Gaussians
    vertex: np.ndarray
    comments: tuple[str, ...]
    notes: tuple[str, ...]
    fingerprint: str
    path: Path
    calibration: Calibration | None = None
    origin: Origin = NOWHERE

    def hook(self, virtual_scale: float = 1.0) -> Hook:
        """The dial for a renderer that has these Gaussians: it turns their opacities into what is drawn of them.

        Raises:
            ClodError: the file has no sigma_d, or the dial is below 1 or not finite.
        """
        if self.gaussians.sigma_d is None or self.gaussians.attenuation is None:
            raise ClodError(f"{self.path}: it has no sigma_d, so there is no dial; clod-adapt adapt gives it one")
        return Hook(self.gaussians.sigma_d, self.gaussians.attenuation, virtual_scale)


def load(path: str | Path, *, activated: Activated | None = None, origin: Origin | None = None) -> Checkpoint:
    """Reads a checkpoint of plain Gaussians, in Inria's, MaskGaussian's, Mip-Splatting's or our extended layout.

    The name's suffix says which format it is (``readers.READERS``); the rest of this is of PLY. Any property order,
    byte order or ascii, with or without normals, SH degree 0 to 4. Rows with a value that is not finite in a used
    column, or with a zero rotation, are dropped and counted in the notes; opacity = +inf stays and means fully opaque.
    In MaskGaussian's old layout (``masks_0, masks_1``) rows with existence probability sigmoid(masks_0 - masks_1) < 0.5
    go too. Mip-Splatting's ``filter_3D`` is fused into scale and opacity.

    Args:
        activated: which values to take as activated already, where no opacity is below -0.1 and half are at
            most 1, or no scale is below 0, as in no usual file of logits and logarithms: "none", "opacity",
            "scales" or "both". Files that this package wrote, and formats that settle it, are not in question.
        origin: what the means are to be relative to, as another checkpoint's are; by default what suits them.

    Raises:
        ClodError: not a checkpoint, damaged, of another kind, nothing usable in it, or values in question and
            ``activated`` is None.
    """
    path = Path(path)
    rows = read_rows(path)
    vertex, was, changes = as_stored_by_inria(path, rows.vertex, "none" if rows.settled else activated)
    columns = column_map(rows.sh_degree)
    names = [name for group in columns.values() for name in group]
    extras = [name for name in (SIGMA, *MASKS) if name in (vertex.dtype.names or ())]
    table = read_table(vertex, names + extras)
    if origin is None:
        origin = origin_of(vertex) if rows.origin is None else rows.origin
    if any(origin):
        table[:, :3] = relative(vertex, origin)
    keep, notes = _usable_rows(path, table, names + extras)
    if any(origin):
        where = ", ".join(f"{value:.10g}" for value in origin)
        notes.append(f"far from 0: read relative to ({where}); outputs have x, y, z as double")
    if not keep.all():
        vertex, table = vertex[keep], table[keep]
    gaussians, calibration = _gaussians(table, columns), None
    if SIGMA in extras:
        attenuation, remarks = read_attenuation(path, rows.comments)
        sigma_d = torch.from_numpy(table[:, len(names)].copy())
        gaussians = gaussians.replace(sigma_d=sigma_d, attenuation=attenuation)
        calibration, doubts = read_calibration(rows.comments, len(gaussians))
        notes += remarks + doubts
    notes = [*changes, *notes, *rows.notes]
    fingerprint = _sha256(path) if was == "none" else f"{was}:{_sha256(path)}"
    return Checkpoint(
        gaussians, vertex, (*rows.comments, *changes), tuple(notes), fingerprint, path, calibration, origin
    )


def save(
    path: str | Path,
    gaussians: Gaussians,
    base: Checkpoint | None = None,
    *,
    version: str | None = None,
    calibration: Calibration | None = None,
) -> None:
    """Writes ``gaussians`` as an extended file: the base's columns, then ``sigma_d``.

    Without a base the columns are those of Inria's layout.

    Row ``i`` of ``gaussians`` is row ``i`` of ``base``. Columns keep name, order and type; a value is
    overwritten only where it differs from the base's float32 reading, so what was not tuned stays
    byte-equal. Where the base has an origin, x, y and z are written as double. The settings follow the element line
    as comments. Without a sigma_d a plain file results.

    Args:
        version: of the package that made the values, for the header (``Adapter.version``); by default the running one.
        calibration: of these Gaussians, for the header. The base's is not passed on, which is of the base.

    Raises:
        ClodError: there are no Gaussians, they do not match the base, a new value is not finite, the target is the
            base itself or cannot be written.
    """
    path = Path(path)
    if len(gaussians) == 0:
        raise ClodError(f"{path}: there are no Gaussians to write, and no reader takes a file without any")
    base = base or blank(len(gaussians), gaussians.sh_degree)
    if path.is_file() and base.path.is_file() and path.samefile(base.path):
        raise ClodError(f"{path}: is the input file, which is never overwritten; choose another output")
    if len(gaussians) != len(base.vertex) or gaussians.sh_degree != base.gaussians.sh_degree:
        raise ClodError(
            f"{path}: {len(gaussians)} Gaussians of SH degree {gaussians.sh_degree} do not fit their base {base.path} "
            f"({len(base.vertex)} of degree {base.gaussians.sh_degree}); save with the checkpoint they came from"
        )
    comments = write_comments(gaussians.attenuation, base.comments, version, calibration)
    element = PlyElement.describe(_merged(path, gaussians, base), "vertex", comments=comments)
    with atomic_path(path) as temporary:
        PlyData([element], byte_order="<").write(str(temporary))


def blank(count: int, sh_degree: int, origin: Origin = NOWHERE) -> Checkpoint:
    """A base of zeros in Inria's layout (normals included), for Gaussians that come from no file, or not as rows."""
    groups = column_map(sh_degree)
    vertex = _with_doubles(np.zeros(count, inria_dtype(sh_degree)), origin)
    gaussians = _gaussians(np.zeros((count, sum(map(len, groups.values()))), np.float32), groups)
    for axis, value in zip(AXES, origin, strict=True):
        vertex[axis] = value
    return Checkpoint(gaussians, vertex, (), (), "", Path(), origin=origin)


def _usable_rows(path: Path, table: np.ndarray, names: list[str]) -> tuple[np.ndarray, list[str]]:
    """``[N]`` bool, which rows to keep, and a note for every reason by which some went."""
    total, opacity = len(table), table[:, names.index("opacity")]
    notes, keep = [], np.ones(total, bool)
    for rule, reason in row_rules(table, names):
        gone = int((keep & ~rule).sum())
        keep = keep & rule
        if gone:
            notes.append(f"{gone} of {total} Gaussians dropped: {reason}")
    if not keep.any():
        raise ClodError(f"{path}: no usable Gaussian in it ({'; '.join(notes) or 'it has 0 rows'}); export it again")
    opaque = int((opacity[keep] == np.inf).sum())
    return keep, notes + ([f"{opaque} Gaussians have opacity = +inf and are taken as fully opaque"] if opaque else [])


def _gaussians(table: np.ndarray, columns: dict[str, tuple[str, ...]]) -> Gaussians:
    tensors: dict[str, Any] = {}
    start = 0
    for name, group in columns.items():
        shape = {"opacity_logits": (), "sh0": (1, 3), "shN": (len(group) // 3, 3)}.get(name, (len(group),))
        values = table[:, start : start + len(group)].copy()
        tensors[name] = torch.from_numpy(values.reshape(len(table), *shape))
        start += len(group)
    return Gaussians(**tensors)


def _merged(path: Path, gaussians: Gaussians, base: Checkpoint) -> np.ndarray:
    """The base's rows with changed values written in and sigma_d as the last column."""
    vertex = _with_doubles(base.vertex, base.origin)
    names = [name for name in vertex.dtype.names or () if name != SIGMA]
    dtype = [(name, vertex.dtype[name]) for name in names]
    merged = np.empty(len(vertex), dtype + ([(SIGMA, np.dtype("f4"))] if gaussians.sigma_d is not None else []))
    for name in names:
        merged[name] = vertex[name]
    for attribute, group in column_map(gaussians.sh_degree).items():
        new = _numpy(getattr(gaussians, attribute)).reshape(len(vertex), -1)
        old = relative(vertex, base.origin) if attribute == "means" else read_table(vertex, group)
        changed = new.view(np.uint32) != old.view(np.uint32)
        if not np.isfinite(new[changed]).all():
            raise ClodError(f"{path}: {attribute} holds a new value that is not finite; the tuning has diverged")
        for column in np.flatnonzero(changed.any(0)):
            rows = changed[:, column]
            shift = base.origin[column] if attribute == "means" else 0.0
            merged[group[column]][rows] = new[rows, column].astype(np.float64) + shift if shift else new[rows, column]
    if gaussians.sigma_d is not None:
        merged[SIGMA] = _numpy(gaussians.sigma_d)
        if not np.isfinite(merged[SIGMA]).all():
            raise ClodError(f"{path}: {SIGMA} holds a value that is not finite; use a large number for no decay")
    return merged


def _with_doubles(vertex: np.ndarray, origin: Origin) -> np.ndarray:
    """The rows with coordinates that have digits for what is far from 0, where the origin is."""
    names = vertex.dtype.names or ()
    wider = [(name, np.dtype("f8") if name in AXES else vertex.dtype[name]) for name in names]
    return vertex.astype(wider) if any(origin) else vertex


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().float().cpu().numpy())


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            for block in iter(lambda: file.read(1 << 20), b""):
                digest.update(block)
    except OSError as error:
        raise ClodError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    return digest.hexdigest()
