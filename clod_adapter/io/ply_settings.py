"""The settings in a PLY: comments of the header, and constant columns for tools that drop comments and keep columns.

A setting that is not the default is stored in a float column whose name begins with ``clod_`` too, before ``sigma_d``.
``reference_distance`` is stored so where there is a ``growth_d``, which is measured in it.
``max_sv``, the end of the trained range, has no column: reading sigma_d does not need it.
"""

from collections.abc import Iterable
from dataclasses import asdict, astuple, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter._support.version import package_version
from clod_adapter.calibration import CalibrationRow, Viewpoint
from clod_adapter.config import CLASSIC, AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.settings import FILTER, Metadata, read_metadata, tagged

PREFIX = "clod_adapter "
COLUMN = "clod_"
# Comments of the calibration: machine; total, views, width, height, reference; one for each row and each viewpoint.
MACHINE, EXTENT, ROW, VIEWPOINT = "calibrated_on", "calibrated_with", "calibrated", "viewpoint"
_USUAL = asdict(AttenuationConfig())


def ply_metadata(path: Path, comments: tuple[str, ...], rows: np.ndarray | None = None, *, dial: bool) -> Metadata:
    """The settings of the comments, completed by those of the columns of ``rows``."""
    columns = _constant_settings(path, rows) if dial and rows is not None else {"attenuation": {}}
    ours = any(comment.startswith(PREFIX) for comment in comments)
    values = columns | _stored_settings(comments)
    values["attenuation"] = columns["attenuation"] | values["attenuation"]
    found = read_metadata(path, values, dial=dial, described=ours)
    names = ", ".join([] if ours else columns["attenuation"])
    notes = (f"settings of the dial read from columns: {names}",) if names else ()
    return replace(found, notes=(*notes, *found.notes))


def write_comments(metadata: Metadata) -> list[str]:
    """The comments of an output: its lines of history, then the settings, without other settings among the lines.

    One comment per setting, as ``clod_adapter tau 0.00392156862745098``: the shortest decimal that gives the same
    double. Some readers do not take long comments, so each row of the calibration has its own.
    """
    dial, screen_filter, c = metadata.attenuation, metadata.screen_filter or CLASSIC, metadata.calibration
    lines = [f"version {metadata.version or package_version()}"]
    lines += [f"{name} {type(usual)(getattr(dial, name))}" for name, usual in _USUAL.items() if dial]
    lines += [f"{FILTER} {screen_filter.variance} {screen_filter.compensate}"] if screen_filter != CLASSIC else []
    if c is not None:
        lines += [f"{MACHINE} {c.machine}", f"{EXTENT} {c.total} {c.views} {c.width} {c.height} {c.against}"]
        lines += [f"{ROW} {' '.join(map(repr, astuple(row)))}" for row in c.rows]
        lines += [f"{VIEWPOINT} {' '.join(map(repr, astuple(place)))}" for place in c.viewpoints]
    about = [line for line in metadata.about if not line.startswith(PREFIX)]
    return [*tagged(about, screen_filter), *(PREFIX + line for line in lines)]


def _stored_settings(comments: Iterable[str]) -> dict[str, Any]:
    """The settings in the comments, as ``settings.read_metadata`` takes them; the last of equal names counts."""
    found: dict[str, list[list[str]]] = {}
    for name, *words in (line[len(PREFIX) :].split() or [""] for line in comments if line.startswith(PREFIX)):
        found.setdefault(name, []).append(words)
    machine, extent, rows, viewpoints = (found.pop(name, []) for name in (MACHINE, EXTENT, ROW, VIEWPOINT))
    values: dict[str, Any] = {FILTER: " ".join(found.pop(FILTER)[-1])} if FILTER in found else {}
    if machine or extent or rows or viewpoints:
        measured: dict[str, Any] = {
            "rows": _records(rows, CalibrationRow),
            "viewpoints": _records(viewpoints, Viewpoint),
        }
        for words in extent:
            measured |= zip(("total", "views", "width", "height"), words, strict=False)
            measured |= {"against": " ".join(words[4:])} if words[4:] else {}
        values["calibration"] = measured | {"machine": " ".join(machine[-1])} if machine else measured
    settings = {name: " ".join(lines[-1]) for name, lines in found.items() if lines[-1]}
    return values | {"package_version": settings.pop("version", ""), "attenuation": settings}


def _records(lines: list[list[str]], kind: type) -> list[dict[str, str]]:
    """The fields of each line, without those that are missing."""
    names = [field.name for field in fields(kind)]
    return [dict(zip(names, words, strict=False)) for words in lines]


def constants_of(metadata: Metadata, *, growth: bool) -> dict[str, float]:
    """The columns, by name, of settings of a dial that are not the defaults; sigma_d in world units."""
    dial, screen_filter = metadata.attenuation, metadata.screen_filter or CLASSIC
    if dial is None:  # a plain file has the columns of Inria's layout and no others
        return {}
    columns = (
        ("tau", dial.tau, dial.tau != _USUAL["tau"]),
        ("eps", dial.eps, dial.eps != _USUAL["eps"]),
        ("hard_cut", 1.0, dial.cut == "hard"),
        ("reference_distance", dial.reference_distance, growth and dial.reference_distance > 0),
        ("max", 1.0, dial.normalizer == "max"),
        ("screen_variance", screen_filter.variance, screen_filter.variance != CLASSIC.variance),
        ("compensate", 1.0, screen_filter.compensate),
    )
    return {COLUMN + name: value for name, value, there in columns if there}


def _constant_settings(path: Path, vertex: np.ndarray) -> dict[str, Any]:
    """The settings in the columns, as ``settings.read_metadata`` takes them; the inverse of ``constants_of``."""
    there = dict[str, float]()
    for name in vertex.dtype.names or ():
        if name.startswith(COLUMN) and len(vertex):
            if not (vertex[name] == vertex[name][0]).all():
                raise ClodError(
                    f"{path}: property {name} must be one value for all rows and has several, so files of different "
                    "settings were merged; give one of them"
                )
            there[name.removeprefix(COLUMN)] = _simplest(vertex[name][0])
    found: dict[str, Any] = {n: there[n] for n in ("tau", "eps", "reference_distance") if n in there}
    found |= {"cut": "hard"} if there.get("hard_cut") else {}
    found |= {"normalizer": "max"} if there.get("max") else {}
    found |= {"normalizer": "quantile"} if there.get("quantile") else {}  # of earlier versions; refused
    values: dict[str, Any] = {"attenuation": found}
    if "screen_variance" in there or "compensate" in there:
        variance = there.get("screen_variance", CLASSIC.variance)
        values[FILTER] = {"variance": variance, "compensate": bool(there.get("compensate"))}
    return values


def _simplest(value: Any) -> float:
    """The simplest number that float32 rounds to ``value``, which is the number that was written.

    The shortest decimal; where that has more than six digits, 1/n if that is one for a whole n (1/255).
    """
    narrow = np.float32(value)
    shortest = float(str(narrow))
    if np.float32(f"{shortest:.6g}") == narrow or not 0 < shortest < 1:  # six digits, which every float32 holds
        return shortest
    fraction = 1 / round(1 / shortest)
    return fraction if np.float32(fraction) == narrow else shortest
