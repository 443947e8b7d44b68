"""Checkpoints: a reader of every format."""

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clod_adapter.cameras import Camera, with_near_planes
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import reach_fade
from clod_adapter.equation.distances import camera_of
from clod_adapter.equation.units import nominal_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.hook import Hook
from clod_adapter.io.file_formats import PLY, format_of, read_source, write
from clod_adapter.io.ply_layout import PREFIX, write_rows
from clod_adapter.io.ranks import ranks_of
from clod_adapter.io.settings import (
    WARNING,
    Metadata,
    matching_quality_table,
    stated_filter,
)
from clod_adapter.io.values import SIGMA, Activated, Prepared, prepared
from clod_adapter.origin import NOWHERE, Origin
from clod_adapter.quality_table import QualityTable, Viewpoint

# Adapted files of three captures keep 38 to 97 % at s = 1, with sigma_d in other units 3 to 43 %.
DOUBTFUL = 0.25


@dataclass(frozen=True)
class Checkpoint:
    """A file as read: its Gaussians, and what the writer keeps of it.

    Attributes:
        gaussians: the usable Gaussians, float32; with sigma_d and attenuation, and perhaps
            growth_d, if the file is extended.
        vertex: of a PLY, ``[N]`` structured array: the same rows with every column as it is in the
            file, native byte order; None for other formats.
        comments: the header's but the settings, or the lines of history of another format.
        notes: what was dropped or noticed, one line each.
        fingerprint: SHA-256 of the file's bytes, hex, or of those of all ranks; preceded by
            "opacity:", "scales:" or "both:" where values were taken as activated.
        path: of the file.
        quality_table: what its dial values keep, cost and take, if it stores that.
        origin: ``[3]`` what the means are relative to, world units: not 0 only for a scene far from
            0, whose photographs are to be read relative to it too (``load_scene``). Outputs have
            the file's own coordinates.
        filter_known: whether the file states its screen-space filter, or a dial was tuned with it;
            else that of the Gaussians is only implied.
    """

    gaussians: Gaussians
    vertex: np.ndarray | None
    comments: tuple[str, ...]
    notes: tuple[str, ...]
    fingerprint: str
    path: Path
    quality_table: QualityTable | None = None
    origin: Origin = NOWHERE
    filter_known: bool = False

    def __repr__(self) -> str:
        return f"Checkpoint({str(self.path)!r}, {self.gaussians.summary})"

    @property
    def viewpoints(self) -> tuple[Viewpoint, ...]:
        """Viewpoints of the quality table, relative to the origin as the Gaussians are; empty
        without a quality table.
        """
        stored = self.quality_table.viewpoints if self.quality_table else ()
        back = [-value for value in self.origin]
        return tuple(viewpoint.moved(back) for viewpoint in stored)

    @property
    def cameras(self) -> list[Camera]:
        """The viewpoints as cameras with the size of the quality table's images."""
        if self.quality_table is None:
            return []
        size = self.quality_table.width, self.quality_table.height
        looking = [viewpoint for viewpoint in self.viewpoints if viewpoint.fov > 0]
        cameras = []
        for number, viewpoint in enumerate(looking, start=1):
            cameras.append(camera_of(viewpoint, *size, f"viewpoint {number}"))
        return with_near_planes(cameras)

    @property
    def placed(self) -> bool:
        """Whether these cameras were placed without photographs, so that they do not tell which way
        is up.
        """
        return self.quality_table is not None and self.quality_table.against == "checkpoint"

    def hook(self, virtual_scale: float = 1.0) -> Hook:
        """The dial for a renderer that has these Gaussians: attenuated opacities, and factors of
        the scales.

        Raises:
            ClodError: the file has no sigma_d, or the dial is negative or not finite.
        """
        gaussians = self.gaussians
        if gaussians.sigma_d is None or gaussians.attenuation is None:
            raise ClodError(
                f"{self.path}: it has no sigma_d, so there is no dial; clod-adapt adapt gives"
                " it one"
            )
        return Hook(gaussians.sigma_d, gaussians.attenuation, virtual_scale, gaussians.growth_d)


@torch.inference_mode(False)  # training takes no inference tensors
def load(
    path: str | Path, *, activated: Activated | None = None, origin: Origin | None = None
) -> Checkpoint:
    """Reads a checkpoint of plain Gaussians; the suffix decides the format
    (``file_formats.FORMATS``).

    A PLY may have Inria's, MaskGaussian's, Mip-Splatting's or our extended layout: any property
    order, byte order or ascii, with or without normals, SH degree 0 to 3. It is read once; the
    fingerprint is of the bytes that were parsed. Of a checkpoint of several GPUs any rank stands
    for all, which lie in its folder.

    Rows with a value that is not finite in a used column, or with a zero rotation, are dropped and
    counted in the notes; opacity = +inf stays and means fully opaque. Of MaskGaussian's old layout
    (``masks_0, masks_1``) rows with existence probability sigmoid(masks_0 - masks_1) < 0.5 are
    dropped too. Mip-Splatting's ``filter_3D`` is fused into scale and opacity.

    Args:
        activated: which values are activated already, for a file where no opacity is below -0.1 and
            half are at most 1, or no scale is below 0, as in no usual file of logits and
            logarithms: "none", "opacity", "scales" or "both". Not needed for files of this package,
            and for formats that define it.
        origin: what the means are to be relative to, world units; by default chosen by
            ``origin_of``.

    Raises:
        ClodError: not a checkpoint, damaged, of another kind, nothing usable in it, or the range of
            the values leaves open whether they are activated and ``activated`` is None.
    """
    path = Path(path)
    source = read_source(path)
    metadata = source.metadata
    dial = SIGMA in source.arrays
    values = prepared(
        path,
        source.arrays,
        activated if source.activation_unknown else "none",
        metadata.origin,
        origin,
    )
    arrays = values.arrays
    rows = source.rows
    if not values.keep.all():
        arrays = {name: array[values.keep] for name, array in arrays.items()}
        if rows is not None:
            rows = rows[values.keep]
    screen_filter = stated_filter(source)
    tensors: dict[str, Any] = {name: torch.from_numpy(array) for name, array in arrays.items()}
    gaussians = Gaussians(
        **tensors, attenuation=metadata.attenuation if dial else None, screen_filter=screen_filter
    )
    notes = [*_notes_of(values, arrays["opacity_logits"]), *metadata.notes]
    if gaussians.attenuation is not None and not metadata.described:
        notes += plausibility(arrays, gaussians.attenuation)
    quality_table, mismatch = (
        matching_quality_table(metadata, len(gaussians)) if dial else (None, [])
    )
    about = [
        re.sub("[^\t -~]", "?", line) for line in source.comments if not line.startswith(PREFIX)
    ]
    return Checkpoint(
        gaussians,
        rows,
        (*about, *values.changes),
        (*notes, *mismatch, *source.notes),
        source.sha256 if values.activated == "none" else f"{values.activated}:{source.sha256}",
        path,
        quality_table,
        values.origin,
        filter_known=dial or metadata.screen_filter is not None,
    )


def _notes_of(values: Prepared, opacity_logits: np.ndarray) -> list[str]:
    """What was changed or dropped, and what is odd about the rest, one line each."""
    notes = [*values.changes]
    for reason, lost in values.dropped.items():
        notes.append(f"{lost} of {len(values.keep)} Gaussians dropped: {reason}")
    if opacity_logits.max() == np.inf:  # else no mask is made
        opaque = np.count_nonzero(opacity_logits == np.inf)
        notes.append(f"{opaque} Gaussians have opacity = +inf and are taken as fully opaque")
    if any(values.origin):
        where = ", ".join(f"{value:.10g}" for value in values.origin)
        notes.append(f"far from 0: read relative to ({where}); outputs have x, y, z as double")
    return notes


@torch.no_grad()
def plausibility(arrays: Mapping[str, np.ndarray], config: AttenuationConfig) -> list[str]:
    """States the share that a dial without settings keeps at s = 1 from the nominal distance.

    A warning where that is too small, as of a file whose positions were enlarged. Nothing for the
    paper's form, which is invariant to scale.
    """
    if config.form == "paper":
        return []
    means, sigma_d = (torch.from_numpy(arrays[name]) for name in ("means", SIGMA))
    d = nominal_distance(means, config)
    is_kept = reach_fade(sigma_d, torch.full_like(sigma_d, d, dtype=torch.float64))[1]
    share = float(is_kept.double().mean())
    reading = f"read as sigma_d in world units: keeps {share:.0%} at s = 1"
    about = f"its dial is not described in the file; {reading} from {d:.3g} away"
    if share < DOUBTFUL:
        remedy = "give the file as clod-adapt wrote it, before another tool rewrote or rescaled it"
        return [f"{WARNING}{about}, likely not what was adapted; {remedy}"]
    return [f"{about}; not right if another tool rescaled it"]


def save(
    path: str | Path,
    gaussians: Gaussians,
    base: Checkpoint | None = None,
    *,
    version: str | None = None,
    quality_table: QualityTable | None = None,
) -> None:
    """Writes ``gaussians`` in the format of the path's suffix (``file_formats.WRITABLE``).

    A PLY is an extended file: the base's columns, then ``sigma_d`` and ``growth_d``. Without a base
    the columns are those of Inria's layout. What another format loses is a warning.

    Row ``i`` of ``gaussians`` is row ``i`` of ``base``, after which far Gaussians follow. Columns
    keep name, order and type; a value is overwritten only where it differs from the base's float32
    reading, so what was not tuned stays byte-equal. Where the base has an origin, x, y and z are
    written as double. sigma_d is written in world units (``units.in_world_units``). The settings
    follow the element line as comments, and those that are not the defaults are stored in columns
    too. Without a sigma_d a plain file results.

    Args:
        version: of the package that made the values, for the header (``Adapter.version``); by
            default the running one.
        quality_table: of these Gaussians, for the header. The base's is not passed on, which is of
            the base.

    Raises:
        ClodError: another suffix or none, there are no Gaussians, they do not match the base, a new
            value is not finite, the target is the base itself, cannot be written, or not be read
            again; for another format than PLY also sigma_d that it does not carry.
    """
    path = Path(path)
    metadata = Metadata(quality_table=quality_table, version=version or "")
    rows = None
    if base is not None:
        _check_base(path, gaussians, base)
        metadata = replace(metadata, origin=base.origin, about=base.comments)
        rows = base.vertex
    writer = partial(write_rows, base=rows) if format_of(path) is PLY else None
    for note in write(path, gaussians, metadata, writer=writer):
        warnings.warn(f"{path}: {note}", stacklevel=2)


def _check_base(path: Path, gaussians: Gaussians, base: Checkpoint) -> None:
    """Rejects the base as a target, and Gaussians that do not come from it."""
    inputs = [base.path, *ranks_of(base.path).values()]
    if path.is_file() and any(file.is_file() and path.samefile(file) for file in inputs):
        raise ClodError(
            f"{path}: is the input file, which is never overwritten; choose another output"
        )
    if (
        len(base.gaussians) not in (len(gaussians), gaussians.whole)
        or gaussians.sh_degree != base.gaussians.sh_degree
    ):
        raise ClodError(
            f"{path}: Gaussians ({gaussians.summary}) do not fit their base {base.path}"
            f" ({base.gaussians.summary}); save with the checkpoint they came from"
        )
