"""Checkpoints: a tolerant reader, and a strict writer of the extended PLY."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clod_adapter.calibration import Calibration, Viewpoint
from clod_adapter.config import CLASSIC
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.hook import Hook
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.ply.columns import MASKS, SIGMA, column_map, inria_dtype, read_table
from clod_adapter.io.ply.constants import dial_constants, filter_constants, read_constants
from clod_adapter.io.ply.header import (
    has_settings,
    read_attenuation,
    read_calibration,
    read_screen_filter,
    write_comments,
)
from clod_adapter.io.ply.plausible import judge
from clod_adapter.io.ply.usable import row_rules
from clod_adapter.io.ply.values import Activated, as_stored_by_inria
from clod_adapter.io.ply.write import ROWS, write_rows
from clod_adapter.io.readers import read_rows
from clod_adapter.io.screen_filter import likely
from clod_adapter.origin import AXES, NOWHERE, Origin, origin_of, relative
from clod_adapter.units import in_world_units


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
        filter_known: whether the file says which screen-space filter it was trained with, or a dial was tuned with it;
            else that of the Gaussians is only the likely one.
    """

    gaussians: Gaussians
    vertex: np.ndarray
    comments: tuple[str, ...]
    notes: tuple[str, ...]
    fingerprint: str
    path: Path
    calibration: Calibration | None = None
    origin: Origin = NOWHERE
    filter_known: bool = False

    @property
    def viewpoints(self) -> tuple[Viewpoint, ...]:
        """Those of the calibration, relative to the origin as the Gaussians are; empty where the file has none."""
        stored = self.calibration.viewpoints if self.calibration else ()
        return tuple(viewpoint.moved([-value for value in self.origin]) for viewpoint in stored)

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
    names = rows.vertex.dtype.names or ()
    constants = read_constants(path, rows.vertex) if SIGMA in names else {}
    said, expected = read_screen_filter(path, rows.comments, constants), likely(rows.comments, names)
    vertex, was, changes = as_stored_by_inria(path, rows.vertex, "none" if rows.settled else activated)
    if origin is None:
        origin = origin_of(vertex) if rows.origin is None else rows.origin
    values, keep, notes = _gather(path, vertex, rows.sh_degree, origin)
    if any(origin):
        where = ", ".join(f"{value:.10g}" for value in origin)
        notes.append(f"far from 0: read relative to ({where}); outputs have x, y, z as double")
    if not keep.all():
        vertex = vertex[keep]
    gaussians, calibration = _gaussians(values), None
    if SIGMA in values:
        attenuation, remarks = read_attenuation(path, rows.comments, constants)
        sigma_d = torch.from_numpy(values[SIGMA][:, 0])
        gaussians = gaussians.replace(sigma_d=sigma_d, attenuation=attenuation)
        if not has_settings(rows.comments):
            remarks += judge(gaussians.means, gaussians.opacity_logits, sigma_d, attenuation)
        calibration, doubts = read_calibration(rows.comments, len(gaussians))
        notes += remarks + doubts
        expected = CLASSIC  # what a dial was tuned with, where nothing says
    gaussians = gaussians.replace(screen_filter=said or expected)
    notes = [*changes, *notes, *rows.notes]
    fingerprint = _sha256(path) if was == "none" else f"{was}:{_sha256(path)}"
    return Checkpoint(
        gaussians, vertex, (*rows.comments, *changes), tuple(notes), fingerprint, path, calibration, origin,
        filter_known=said is not None or SIGMA in values,
    )  # fmt: skip


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
    byte-equal. Where the base has an origin, x, y and z are written as double. sigma_d is written in world units
    (``units.in_world_units``). The settings follow the element line as comments, and those that are not the defaults
    stand in columns too (``ply_constants``). Without a sigma_d a plain file results.

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
    gaussians = in_world_units(gaussians)
    comments = write_comments(gaussians.attenuation, base.comments, version, calibration, gaussians.screen_filter)
    constants = dial_constants(gaussians.attenuation)
    if gaussians.sigma_d is not None:  # a plain file has the columns of Inria's layout and no others
        constants |= filter_constants(gaussians.screen_filter)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        write_rows(file, path, gaussians, base.vertex, base.origin, comments, constants)


def blank(count: int, sh_degree: int, origin: Origin = NOWHERE) -> Checkpoint:
    """A base of zeros in Inria's layout (normals included), for Gaussians that come from no file, or not as rows."""
    kinds = [(name, "f8" if any(origin) and name in AXES else "f4") for name in inria_dtype(sh_degree).names or ()]
    vertex = np.zeros(count, kinds)
    groups = column_map(sh_degree)
    gaussians = _gaussians({name: np.zeros((count, len(group)), np.float32) for name, group in groups.items()})
    for axis, value in zip(AXES, origin, strict=True):
        vertex[axis] = value
    return Checkpoint(gaussians, vertex, (), (), "", Path(), origin=origin)


def _gather(
    path: Path, vertex: np.ndarray, sh_degree: int, origin: Origin
) -> tuple[dict[str, np.ndarray], np.ndarray, list[str]]:
    """The usable rows' attributes ``[M, P]`` float32, and sigma_d; ``[N]`` which they are; why others are not."""
    there = [name for name in (SIGMA, *MASKS) if name in (vertex.dtype.names or ())]
    groups = column_map(sh_degree) | ({SIGMA: (SIGMA,)} if SIGMA in there else {})
    names = [name for group in column_map(sh_degree).values() for name in group] + there
    values = {key: np.empty((len(vertex), len(group)), np.float32) for key, group in groups.items()}
    keep, gone, opaque = np.ones(len(vertex), bool), dict[str, int](), 0
    for start in range(0, len(vertex), ROWS):
        rows = slice(start, start + ROWS)
        table, usable, at = read_table(vertex[rows], names), keep[rows], 0
        if any(origin):
            table[:, :3] = relative(vertex[rows], origin)
        for rule, reason in row_rules(table, names):
            gone[reason] = gone.get(reason, 0) + int((usable & ~rule).sum())
            usable &= rule
        opaque += int((table[usable, names.index("opacity")] == np.inf).sum())
        for key, group in groups.items():
            values[key][rows] = table[:, at : at + len(group)]
            at += len(group)
    notes = [f"{lost} of {len(vertex)} Gaussians dropped: {reason}" for reason, lost in gone.items() if lost]
    if not keep.any():
        raise ClodError(f"{path}: no usable Gaussian in it ({'; '.join(notes) or 'it has 0 rows'}); export it again")
    if not keep.all():
        values = {key: array[keep] for key, array in values.items()}
    return (
        values,
        keep,
        notes + ([f"{opaque} Gaussians have opacity = +inf and are taken as fully opaque"] * (opaque > 0)),
    )


def _gaussians(values: dict[str, np.ndarray]) -> Gaussians:
    """Of the attributes' columns ``[N, P]``, whose memory they use."""
    tensors: dict[str, Any] = {name: torch.from_numpy(values[name]) for name in column_map(0)}
    tensors["opacity_logits"] = tensors["opacity_logits"][:, 0]
    for name in ("sh0", "shN"):
        tensors[name] = tensors[name].unflatten(1, (values[name].shape[1] // 3, 3))
    return Gaussians(**tensors)


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            for block in iter(lambda: file.read(1 << 20), b""):
                digest.update(block)
    except OSError as error:
        raise ClodError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    return digest.hexdigest()
