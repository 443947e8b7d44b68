"""The layout of PLY files: columns, and settings in comments and columns, both ways; and writing.

A setting that is not the default is stored in a comment, and for tools that drop comments and keep
columns in a constant float column too, whose name begins with ``clod_``, before ``sigma_d``.
``reference_distance`` is stored so where there is a ``growth_d``, which is measured in it.
``max_sv``, the end of the trained range, has no column: reading sigma_d does not need it.
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import asdict, astuple, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from plyfile import PlyData, PlyElement

from clod_adapter._support.text import package_version
from clod_adapter.calibration import CalibrationRow, Viewpoint
from clod_adapter.config import CLASSIC, SH_COUNTS, AttenuationConfig
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
    sh0_of,
)

if TYPE_CHECKING:
    from clod_adapter.gaussians import Gaussians

PREFIX = "clod_adapter "
COLUMN = "clod_"
RGB = ("red", "green", "blue")
# Comments of the calibration: machine; total, views, width, height, reference; one for each row and
# each viewpoint.
MACHINE = "calibrated_on"
EXTENT = "calibrated_with"
ROW = "calibrated"
VIEWPOINT = "viewpoint"
DIAL = "attenuation"
# Of the columns of settings: group, field, and what a column of 1 stands for where the setting is
# no number.
_SETTINGS: dict[str, tuple[str, str, Any]] = {
    "reference_distance": (DIAL, "reference_distance", None),
    "near_distance": (DIAL, "near_distance", None),
    "paper": (DIAL, "form", "paper"),
    "screen_variance": (FILTER, "variance", None),
    "compensate": (FILTER, "compensate", True),
}
# the columns of ``settings.EARLIER``
_EARLIER = {"clod_tau", "clod_eps", "clod_hard_cut", "clod_max", "clod_quantile"}
_USUAL = {DIAL: asdict(AttenuationConfig()), FILTER: asdict(CLASSIC)}
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
        "shN": tuple(f"f_rest_{c * bands + k}" for k in range(bands) for c in range(3)),
    }


def is_coloured(names: Container[str]) -> bool:
    """Whether RGB stands for the harmonics, as ``ns-export gaussian-splat --ply-color-mode rgb``
    writes it.
    """
    return (
        all(name in names for name in (*RGB, "scale_0"))
        and "f_dc_0" not in names
        and "f_rest_0" not in names
    )


def with_harmonics(rows: np.ndarray) -> np.ndarray:
    """The rows with f_dc in the place of RGB."""
    names = {
        name: f"f_dc_{RGB.index(name)}" if name in RGB else name for name in rows.dtype.names or ()
    }
    found = np.empty(
        len(rows), [(new, "f4" if old in RGB else rows.dtype[old]) for old, new in names.items()]
    )
    for old, new in names.items():
        found[new] = sh0_of(rows[old]) if old in RGB else rows[old]
    return found


def inria_dtype(sh_degree: int, dial: Iterable[str] = ()) -> np.dtype:
    """The rows that Inria's trainer writes, normals included, and the dial's columns."""
    groups = column_map(sh_degree)
    rest = (f"f_rest_{k}" for k in range(len(groups["shN"])))  # the map lists them by coefficient
    names = [*groups["means"], "nx", "ny", "nz", *groups["sh0"], *rest]
    names += [*groups["opacity_logits"], *groups["log_scales"], *groups["quats"], *dial]
    return np.dtype([(name, "f4") for name in names])


def ply_metadata(
    path: Path, comments: tuple[str, ...], rows: np.ndarray | None = None, *, dial: bool
) -> Metadata:
    """The settings of the comments, completed by those of the columns of ``rows``."""
    columns = _constant_settings(path, rows) if dial and rows is not None else {DIAL: {}}
    ours = any(comment.startswith(PREFIX) for comment in comments)
    values = columns | _stored_settings(comments)
    values[DIAL] = columns[DIAL] | values[DIAL]
    found = read_metadata(path, values, dial=dial, described=ours)
    names = ", ".join([] if ours else columns[DIAL])
    notes = (f"settings of the dial read from columns: {names}",) if names else ()
    return replace(found, notes=(*notes, *found.notes))


def write_comments(metadata: Metadata) -> list[str]:
    """The comments of an output: its lines of history, then the settings, without other settings
    among the lines.

    One comment per setting, as ``clod_adapter reference_distance 3.2``: the shortest decimal that
    gives the same double. Some readers do not take long comments, so each row of the calibration
    has its own.
    """
    dial, screen_filter, c = (
        metadata.attenuation,
        metadata.screen_filter or CLASSIC,
        metadata.calibration,
    )
    lines = [f"version {metadata.version or package_version()}"]
    lines += [
        f"{name} {type(usual)(getattr(dial, name))}" for name, usual in _USUAL[DIAL].items() if dial
    ]
    lines += (
        [f"{FILTER} {screen_filter.variance} {screen_filter.compensate}"]
        if screen_filter != CLASSIC
        else []
    )
    if c is not None:
        lines += [
            f"{MACHINE} {c.machine}",
            f"{EXTENT} {c.total} {c.views} {c.width} {c.height} {c.against}",
        ]
        lines += [f"{ROW} {' '.join(map(repr, astuple(row)))}" for row in c.rows]
        lines += [f"{VIEWPOINT} {' '.join(map(repr, astuple(place)))}" for place in c.viewpoints]
    about = [line for line in metadata.about if not line.startswith(PREFIX)]
    return [*tagged(about, screen_filter), *(PREFIX + line for line in lines)]


def _stored_settings(comments: Iterable[str]) -> dict[str, Any]:
    """The settings in the comments, as ``settings.read_metadata`` takes them; the last of equal
    names counts.
    """
    found: dict[str, list[list[str]]] = {}
    for name, *words in (
        line[len(PREFIX) :].split() or [""] for line in comments if line.startswith(PREFIX)
    ):
        found.setdefault(name, []).append(words)
    values = dict[str, Any]()
    if FILTER in found:
        values[FILTER] = dict(zip(_USUAL[FILTER], found.pop(FILTER)[-1], strict=False))
    measured: dict[str, Any] = {
        name: [
            dict(zip((field.name for field in fields(kind)), words, strict=False))
            for words in found.pop(key, [])
        ]
        for name, key, kind in (("rows", ROW, CalibrationRow), ("viewpoints", VIEWPOINT, Viewpoint))
    }
    settings = {name: " ".join(lines[-1]) for name, lines in found.items() if lines[-1]}
    extent = settings.pop(EXTENT, "").split(maxsplit=4)
    measured |= zip(("total", "views", "width", "height", "against"), extent, strict=False)
    measured |= {"machine": settings.pop(MACHINE)} if MACHINE in settings else {}
    values |= {"calibration": measured} if any(measured.values()) else {}
    return values | {"package_version": settings.pop("version", ""), DIAL: settings}


def constants_of(metadata: Metadata, *, growth: bool) -> dict[str, float]:
    """The columns, by name, of settings of a dial that are not the defaults; sigma_d in world
    units.
    """
    if metadata.attenuation is None:  # a plain file has the columns of Inria's layout and no others
        return {}
    stored, found = (
        {DIAL: asdict(metadata.attenuation), FILTER: asdict(metadata.screen_filter or CLASSIC)},
        {},
    )
    for name, (group, field, word) in _SETTINGS.items():
        value = stored[group][field]
        if (
            value != _USUAL[group][field]
            and word in (None, value)
            and (growth or field != "reference_distance")
        ):
            found[COLUMN + name] = value if word is None else 1.0
    return found


def _constant_settings(path: Path, vertex: np.ndarray) -> dict[str, Any]:
    """The settings in the columns, as ``settings.read_metadata`` takes them; the inverse of
    ``constants_of``.
    """
    found: dict[str, dict[str, Any]] = {DIAL: {}, FILTER: {}}
    there = (vertex.dtype.names or ()) if len(vertex) else ()
    if _EARLIER & {*there}:
        raise ClodError(f"{path}: {EARLIER_FORM}")
    for name, (group, field, word) in _SETTINGS.items():
        if COLUMN + name in there:
            column = vertex[COLUMN + name]
            if not (column == column[0]).all():
                what = f"property {COLUMN}{name} must be one value for all rows and has several"
                raise ClodError(
                    f"{path}: {what}, so files of different settings were merged; give one of them"
                )
            if word is None or column[0]:
                # The shortest decimal of a float32, which is the number that was written.
                found[group][field] = float(str(np.float32(column[0]))) if word is None else word
    return {DIAL: found[DIAL]} | ({FILTER: _USUAL[FILTER] | found[FILTER]} if found[FILTER] else {})


def write(path: Path, gaussians: Gaussians, metadata: Metadata) -> tuple[str, ...]:
    """Writes Gaussians without a base, every value unchanged but opacity = +inf, which some viewers
    do not take.
    """
    from clod_adapter.gaussians import OPAQUE  # here: a header is checked without torch

    arrays_of(path, gaussians)  # refuses rows that load would drop
    opaque = gaussians.opacity_logits.isposinf()
    gaussians = gaussians.replace(
        opacity_logits=gaussians.opacity_logits.masked_fill(opaque, OPAQUE)
    )
    write_rows(path, gaussians, metadata)
    return (
        (f"{int(opaque.sum())} opacities of +inf are written as {OPAQUE:g}, which is 1 too",)
        if opaque.any()
        else ()
    )


def write_rows(
    path: Path, gaussians: Gaussians, metadata: Metadata, base: np.ndarray | None = None
) -> tuple[str, ...]:
    """Writes a binary little-endian PLY, in blocks: a large file is never held twice.

    A column of the base is overwritten where the new value is not the one that was read.

    Args:
        base: ``[N]`` rows of the file that the first N Gaussians come from; None for Inria's
            layout. The others are far Gaussians (``values.OPACITY``), whose other columns are 0.
    """
    tensors, origin = hidden(gaussians), metadata.origin
    constants, dial = (
        constants_of(metadata, growth=gaussians.growth_d is not None),
        dial_columns(tensors),
    )
    layout = inria_dtype(gaussians.sh_degree) if base is None else base.dtype
    # growth_d alone is foreign
    gone = {FILTER_3D, *((SIGMA, GROWTH, OPACITY) if dial else dial_columns(layout.names or ()))}
    own = [name for name in layout.names or () if name not in gone and not name.startswith(COLUMN)]
    kinds = [
        (name, np.dtype("f8") if any(origin) and name in ("x", "y", "z") else layout[name])
        for name in own
    ]
    kind = np.dtype(kinds + [(name, np.dtype("f4")) for name in (*constants, *dial)])
    # plyfile makes a header of this without the rows
    one = np.broadcast_to(np.zeros((), kind), len(gaussians))
    element = PlyElement.describe(one, "vertex", comments=write_comments(metadata))
    with open(path, "wb") as file, np.errstate(over="ignore", invalid="ignore"):
        file.write(f"{PlyData([element], byte_order='<').header}\n".encode("ascii"))
        for start in range(0, len(gaussians), ROWS):
            part = slice(start, start + ROWS)
            block = np.zeros(len(gaussians.means[part]), kind)
            given = block[:0] if base is None else base[part]
            for name in own if len(given) else ():
                block[name][: len(given)] = given[name]
            for name, value in constants.items():
                block[name] = value
            for attribute, group in (column_map(gaussians.sh_degree) | dial).items():
                values = tensors[attribute][part].float().cpu().numpy().reshape(len(block), -1)
                for k, name in enumerate(group):
                    shift = origin[k] if attribute == "means" else 0.0
                    new, changed = values[:, k], np.ones(len(block), bool)
                    if base is not None and name not in dial:
                        old = (block[name] - shift if shift else block[name]).astype(np.float32)
                        changed = new.view(np.uint32) != old.view(np.uint32)
                    new = new[changed]
                    opaque = (
                        new == np.inf if attribute == "opacity_logits" and base is None else False
                    )
                    if not (np.isfinite(new) | opaque).all():
                        fix = _INSTEAD.get(attribute, "the tuning has diverged")
                        raise ClodError(
                            f"{path}: {attribute} holds a new value that is not finite; {fix}"
                        )
                    block[name][changed] = new.astype(np.float64) + shift if shift else new
            file.write(block.astype(kind.newbyteorder("<"), copy=False).data)
    return ()
