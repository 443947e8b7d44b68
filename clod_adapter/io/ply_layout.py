"""The layout of PLY files: columns, and settings in comments and columns, both ways; and writing.

A setting that is not the default is stored in a comment, and for tools that drop comments and keep
columns in a constant float column too, whose name begins with ``clod_``, before ``sigma_d``.
``reference_distance`` is stored so where there is a ``growth_d``, which is measured in it.
``max_sv``, the end of the trained range, has no column: reading sigma_d does not need it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, astuple, fields, replace
from itertools import product, repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from plyfile import PlyData, PlyElement

from clod_adapter._support.text import package_version
from clod_adapter.config import CLASSIC, SH_COUNTS, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.settings import EARLIER_FORM, FILTER, Metadata, read_metadata, tagged
from clod_adapter.io.values import (
    FILTER_3D,
    GROWTH,
    OPACITY,
    ROWS,
    SIGMA,
    arrays_of,
    dial_columns,
    hidden,
)
from clod_adapter.quality_table import QualityRow, Viewpoint

if TYPE_CHECKING:
    from clod_adapter.gaussians import Gaussians

PREFIX = "clod_adapter "
COLUMN = "clod_"  # prefix of the columns of settings, which are
REFERENCE = "clod_reference_distance"
NEAR = "clod_near_distance"
PAPER = "clod_paper"
VARIANCE = "clod_screen_variance"
COMPENSATE = "clod_compensate"
# Comments of the quality table: machine; total, views, width, height, reference; one for each row
# and each viewpoint.
MACHINE = "calibrated_on"
EXTENT = "calibrated_with"
ROW = "calibrated"
VIEWPOINT = "viewpoint"
DIAL_GROUP = "attenuation"
# the columns of ``settings.EARLIER``
_EARLIER = {"clod_tau", "clod_eps", "clod_hard_cut", "clod_max", "clod_quantile"}
# by attribute, what to store instead of a value that is not finite
_INSTEAD = {SIGMA: "use a large number for no end", GROWTH: "use 0 for no growth"}


def column_map(sh_degree: int) -> dict[str, tuple[str, ...]]:
    """The columns of each Gaussians attribute; ``f_rest_{c * (K-1) + k}`` is ``shN[:, k, c]``."""
    bands = SH_COUNTS[sh_degree] - 1
    return {
        "means": ("x", "y", "z"),
        "quats": tuple(f"rot_{i}" for i in range(4)),
        "log_scales": tuple(f"scale_{i}" for i in range(3)),
        "opacity_logits": ("opacity",),
        "sh0": tuple(f"f_dc_{c}" for c in range(3)),
        "shN": tuple(f"f_rest_{c * bands + k}" for k, c in product(range(bands), range(3))),
    }


def inria_dtype(sh_degree: int, dial: Iterable[str] = ()) -> np.dtype:
    """The rows that Inria's trainer writes, normals included, and the dial's columns."""
    groups = column_map(sh_degree)
    higher = (f"f_rest_{k}" for k in range(len(groups["shN"])))  # the map lists them by coefficient
    names = [*groups["means"], "nx", "ny", "nz", *groups["sh0"], *higher]
    names += [*groups["opacity_logits"], *groups["log_scales"], *groups["quats"], *dial]
    return np.dtype([(name, "f4") for name in names])


def ply_metadata(
    path: Path, comments: tuple[str, ...], rows: np.ndarray | None = None, *, dial: bool
) -> Metadata:
    """The settings of the comments, completed by those of the columns of ``rows``; ``dial``: there
    is a sigma_d.
    """
    values = _stored_settings(comments)
    ours = any(comment.startswith(PREFIX) for comment in comments)
    columns = {}
    if dial and rows is not None and len(rows):
        stored = _constant_settings(path, rows)
        columns = stored.pop(DIAL_GROUP)
        values = stored | values | {DIAL_GROUP: columns | values[DIAL_GROUP]}
    metadata = read_metadata(path, values, dial=dial, described=ours)
    if ours or not columns:
        return metadata
    note = f"settings of the dial read from columns: {', '.join(columns)}"
    return replace(metadata, notes=(note, *metadata.notes))


def write_comments(metadata: Metadata) -> list[str]:
    """The comments of an output: its lines of history, then the settings, without other settings
    among the lines.

    One comment per setting, as ``clod_adapter reference_distance 3.2``: the shortest decimal that
    gives the same double. Some readers do not take long comments, so each row of the quality table
    has its own.
    """
    screen_filter = metadata.screen_filter or CLASSIC
    lines = [f"version {metadata.version or package_version()}"]
    if metadata.attenuation is not None:
        for name, usual in asdict(AttenuationConfig()).items():
            lines.append(f"{name} {type(usual)(getattr(metadata.attenuation, name))}")
    if screen_filter != CLASSIC:
        lines.append(f"{FILTER} {screen_filter.variance} {screen_filter.compensate}")
    if (c := metadata.quality_table) is not None:
        lines.append(f"{MACHINE} {c.machine}")
        lines.append(f"{EXTENT} {c.total} {c.views} {c.width} {c.height} {c.against}")
        lines += [f"{ROW} {' '.join(map(repr, astuple(row)))}" for row in c.rows]
        lines += [f"{VIEWPOINT} {' '.join(map(repr, astuple(place)))}" for place in c.viewpoints]
    about = [line for line in metadata.about if not line.startswith(PREFIX)]
    return [*tagged(about, screen_filter), *(PREFIX + line for line in lines)]


def _stored_settings(comments: Iterable[str]) -> dict[str, Any]:
    """The settings in the comments, as ``settings.read_metadata`` takes them; the last of equal
    names counts.
    """
    settings: dict[str, str] = {}
    measured: dict[str, Any] = {"rows": [], "viewpoints": []}
    for line in comments:
        if line.startswith(PREFIX):
            name, _, text = line.removeprefix(PREFIX).partition(" ")
            if name == ROW:
                measured["rows"].append(_by_name(QualityRow, text))
            elif name == VIEWPOINT:
                measured["viewpoints"].append(_by_name(Viewpoint, text))
            else:
                settings[name] = text.strip()
    values: dict[str, Any] = {"package_version": settings.pop("version", "")}
    if FILTER in settings:
        values[FILTER] = _by_name(ScreenFilter, settings.pop(FILTER))
    extent = settings.pop(EXTENT, "").split(maxsplit=4)
    measured |= zip(("total", "views", "width", "height", "against"), extent, strict=False)
    if MACHINE in settings:
        measured["machine"] = settings.pop(MACHINE)
    if any(measured.values()):
        values["calibration"] = measured
    return values | {DIAL_GROUP: settings}


def _by_name(kind: type, text: str) -> dict[str, str]:
    """The words of a text by the fields of a dataclass."""
    return dict(zip([field.name for field in fields(kind)], text.split(), strict=False))


def constants_of(metadata: Metadata, *, growth: bool) -> dict[str, float]:
    """The columns, by name, of settings of a dial that are not the defaults; sigma_d in world
    units.
    """
    if metadata.attenuation is None:  # a plain file has the columns of Inria's layout and no others
        return {}
    usual = _as_columns(AttenuationConfig(), CLASSIC)
    columns = _as_columns(metadata.attenuation, metadata.screen_filter or CLASSIC)
    if not growth:
        del columns[REFERENCE]
    return {name: value for name, value in columns.items() if value != usual[name]}


def _as_columns(config: AttenuationConfig, screen_filter: ScreenFilter) -> dict[str, float]:
    return {
        REFERENCE: config.reference_distance,
        NEAR: config.near_distance,
        PAPER: float(config.form == "paper"),
        VARIANCE: screen_filter.variance,
        COMPENSATE: float(screen_filter.compensate),
    }


def _constant_settings(path: Path, vertex: np.ndarray) -> dict[str, dict[str, Any]]:
    """The settings in the columns, as ``settings.read_metadata`` takes them; the inverse of
    ``constants_of``.
    """
    names = vertex.dtype.names or ()
    if _EARLIER & {*names}:
        raise ClodError(f"{path}: {EARLIER_FORM}")
    found = {}
    for name in _as_columns(AttenuationConfig(), CLASSIC):
        if name in names:
            column = vertex[name]
            if not (column == column[0]).all():
                raise ClodError(
                    f"{path}: property {name} must be one value for all rows and has several, so"
                    " files of different settings were merged; give one of them"
                )
            # the shortest decimal of a float32 is the number that was written
            found[name] = float(str(np.float32(column[0])))
    dial: dict[str, Any] = {}
    if REFERENCE in found:
        dial["reference_distance"] = found[REFERENCE]
    if NEAR in found:
        dial["near_distance"] = found[NEAR]
    if found.get(PAPER):
        dial["form"] = "paper"
    if VARIANCE not in found and COMPENSATE not in found:
        return {DIAL_GROUP: dial}
    variance = found.get(VARIANCE, CLASSIC.variance)
    compensate = bool(found.get(COMPENSATE))
    return {DIAL_GROUP: dial, FILTER: {"variance": variance, "compensate": compensate}}


def write(path: Path, gaussians: Gaussians, metadata: Metadata) -> tuple[str, ...]:
    """Writes Gaussians without a base, every value unchanged but opacity = +inf, which some viewers
    do not take.
    """
    from clod_adapter.gaussians import OPAQUE  # here: a header is checked without torch

    arrays_of(path, gaussians)  # rejects rows that load would drop
    opaque = gaussians.opacity_logits.isposinf()
    logits = gaussians.opacity_logits.masked_fill(opaque, OPAQUE)
    write_rows(path, gaussians.replace(opacity_logits=logits), metadata)
    count = int(opaque.sum())
    note = f"{count} opacities of +inf are written as {OPAQUE:g}, which is 1 too"
    return (note,) if count else ()


def write_rows(
    path: Path, gaussians: Gaussians, metadata: Metadata, base: np.ndarray | None = None
) -> tuple[str, ...]:
    """Writes a binary little-endian PLY, in blocks: a large file is never held twice.

    A column of the base is overwritten where the new value is not the one that was read.

    Args:
        base: ``[N]`` rows of the file that the first N Gaussians come from; None for Inria's
            layout. The others are far Gaussians (``values.OPACITY``), whose other columns are 0.
    """
    tensors = hidden(gaussians)
    constants = constants_of(metadata, growth=gaussians.growth_d is not None)
    dial = dial_columns(tensors)
    layout = inria_dtype(gaussians.sh_degree) if base is None else base.dtype
    names = layout.names or ()
    # growth_d without sigma_d is another program's column, and stays
    dropped = {FILTER_3D, *((SIGMA, GROWTH, OPACITY) if dial else dial_columns(names))}
    copied = [name for name in names if name not in dropped and not name.startswith(COLUMN)]
    kinds = {name: layout[name] for name in copied}
    if any(metadata.origin):
        kinds |= dict.fromkeys("xyz", np.dtype("f8"))
    kinds |= dict.fromkeys((*constants, *dial), np.dtype("f4"))
    kind = np.dtype(list(kinds.items()))
    # plyfile makes a header of this without the rows
    placeholder = np.broadcast_to(np.zeros((), kind), len(gaussians))
    element = PlyElement.describe(placeholder, "vertex", comments=write_comments(metadata))
    with open(path, "wb") as file, np.errstate(over="ignore", invalid="ignore"):
        file.write(f"{PlyData([element], byte_order='<').header}\n".encode("ascii"))
        for start in range(0, len(gaussians), ROWS):
            rows = slice(start, start + ROWS)
            block = np.zeros(len(gaussians.means[rows]), kind)
            if base is not None:
                base_block = base[rows]
                for name in copied:
                    block[name][: len(base_block)] = base_block[name]
            for name, value in constants.items():
                block[name] = value
            for attribute, group in (column_map(gaussians.sh_degree) | dial).items():
                values = tensors[attribute][rows].float().cpu().numpy().reshape(len(block), -1)
                origin = metadata.origin if attribute == "means" else repeat(0.0)
                for name, column, shift in zip(group, values.T, origin, strict=False):
                    new = _overwrite(block[name], column, shift)
                    opaque = attribute == "opacity_logits" and base is None
                    if not (np.isfinite(new) | (opaque & (new == np.inf))).all():
                        fix = _INSTEAD.get(attribute, "the tuning has diverged")
                        raise ClodError(
                            f"{path}: {attribute} holds a new value that is not finite; {fix}"
                        )
            file.write(block.astype(kind.newbyteorder("<"), copy=False).data)
    return ()


def _overwrite(column: np.ndarray, values: np.ndarray, shift: float) -> np.ndarray:
    """Puts values, plus ``shift``, into a column where they are not its own; returns those put."""
    old = (column - shift if shift else column).astype(np.float32)
    changed = values.view(np.uint32) != old.view(np.uint32)
    new = values[changed]
    column[changed] = new.astype(np.float64) + shift if shift else new
    return new
