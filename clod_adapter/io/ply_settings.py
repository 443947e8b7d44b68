"""The settings in a PLY: comments of the header, and constant columns for tools that drop comments and keep columns.

A setting that is not the default is stored in a float column whose name begins with ``clod_`` too, before ``sigma_d``.
``reference_distance`` is stored so where there is a ``growth_d``, which is measured in it.
``max_sv``, the end of the trained range, has no column: reading sigma_d does not need it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter._support.version import package_version
from clod_adapter.calibration import Calibration, CalibrationRow, Viewpoint
from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.settings import FILTER, Metadata, read_metadata, tagged

PREFIX = "clod_adapter "
COLUMN = "clod_"
# Comments of the calibration: machine; total, views, width, height, reference; one for each row and each viewpoint.
MACHINE, EXTENT, ROW, VIEWPOINT = "calibrated_on", "calibrated_with", "calibrated", "viewpoint"


def ply_metadata(path: Path, comments: tuple[str, ...], rows: np.ndarray | None = None, *, dial: bool) -> Metadata:
    """The settings of the comments, completed by those of the columns of ``rows``."""
    columns = _constant_settings(_read_constants(path, rows)) if dial and rows is not None else {}
    ours = any(comment.startswith(PREFIX) for comment in comments)
    values = columns | _stored_settings(comments)
    values["attenuation"] = columns.get("attenuation", {}) | values["attenuation"]
    found = read_metadata(path, values, dial=dial, described=ours)
    if ours or not columns.get("attenuation"):
        return found
    names = ", ".join(columns["attenuation"])
    return replace(found, notes=(f"settings of the dial read from columns: {names}", *found.notes))


def write_comments(
    config: AttenuationConfig | None,
    inherited: Iterable[str],
    version: str | None = None,
    calibration: Calibration | None = None,
    screen_filter: ScreenFilter = CLASSIC,
) -> list[str]:
    """The comments of an output: the inherited ones, then the settings, which replace inherited settings.

    One comment per field of ``config``, as ``clod_adapter tau 0.00392156862745098``: the shortest decimal that gives
    the same double. Some readers do not take long comments, so each row of the calibration has its own.
    """
    comments = tagged([comment for comment in inherited if not comment.startswith(PREFIX)], screen_filter)
    comments.append(f"{PREFIX}version {version or package_version()}")
    for field in fields(config) if config is not None else ():
        value = getattr(config, field.name)
        kind: Any = type(field.default)
        comments.append(f"{PREFIX}{field.name} {value if value is None else kind(value)}")
    if screen_filter != CLASSIC:
        comments.append(f"{PREFIX}{FILTER} {screen_filter.variance} {screen_filter.compensate}")
    if calibration is not None:
        c = calibration
        comments.append(f"{PREFIX}{MACHINE} {c.machine}")
        comments.append(f"{PREFIX}{EXTENT} {c.total} {c.views} {c.width} {c.height} {c.against}")
        for name, lines in ((ROW, c.rows), (VIEWPOINT, c.viewpoints)):
            comments += [f"{PREFIX}{name} {' '.join(map(repr, astuple(line)))}" for line in lines]
    return comments


def _stored_settings(comments: Iterable[str]) -> dict[str, Any]:
    """The settings in the comments, as ``settings.read_metadata`` takes them; the last of equal names counts."""
    found: dict[str, list[list[str]]] = {}
    for words in (comment[len(PREFIX) :].split() for comment in comments if comment.startswith(PREFIX)):
        if words:
            found.setdefault(words[0], []).append(words[1:])
    rows = {name: found.pop(name, []) for name in (MACHINE, EXTENT, ROW, VIEWPOINT)}
    last = {name: " ".join(lines[-1]) for name, lines in found.items() if lines[-1]}
    values: dict[str, Any] = {"package_version": last.pop("version", "")}
    if FILTER in found:
        values[FILTER] = last.pop(FILTER, "")
    if any(rows.values()):
        values["calibration"] = _calibration(rows)
    return values | {"attenuation": last}


def _calibration(lines: dict[str, list[list[str]]]) -> dict[str, Any]:
    """``Calibration.as_dict`` of the comments' words; fields that are missing are left out."""

    def records(name: str, kind: type) -> list[dict[str, str]]:
        return [dict(zip([field.name for field in fields(kind)], words, strict=False)) for words in lines[name]]

    found: dict[str, Any] = {"rows": records(ROW, CalibrationRow), "viewpoints": records(VIEWPOINT, Viewpoint)}
    if len(lines[MACHINE]) == 1:
        found["machine"] = " ".join(lines[MACHINE][0])
    if len(lines[EXTENT]) == 1:
        extent = lines[EXTENT][0]
        found |= zip(("total", "views", "width", "height"), extent, strict=False)
        found |= {"against": " ".join(extent[4:])} if extent[4:] else {}
    return found


def constants_of(config: AttenuationConfig, growth: bool, screen_filter: ScreenFilter) -> dict[str, float]:
    """The columns, by name, of settings that are not the defaults; sigma_d in world units."""
    usual = AttenuationConfig()
    columns = (
        ("tau", config.tau, config.tau != usual.tau),
        ("eps", config.eps, config.eps != usual.eps),
        ("hard_cut", 1.0, config.cut == "hard"),
        ("reference_distance", config.reference_distance, growth and config.reference_distance > 0),
        ("max", 1.0, config.normalizer == "max"),
        ("screen_variance", screen_filter.variance, screen_filter.variance != CLASSIC.variance),
        ("compensate", 1.0, screen_filter.compensate),
    )
    return {COLUMN + name: value for name, value, there in columns if there}


def _constant_settings(constants: Mapping[str, float]) -> dict[str, Any]:
    """The settings in the columns, as ``settings.read_metadata`` takes them; the inverse of ``constants_of``."""
    there = {name.removeprefix(COLUMN): value for name, value in constants.items()}
    found: dict[str, Any] = {n: there[n] for n in ("tau", "eps", "reference_distance") if n in there}
    found |= {"cut": "hard"} if there.get("hard_cut") else {}
    found |= {"normalizer": "max"} if there.get("max") else {}
    values: dict[str, Any] = {"attenuation": found} if found else {}
    if "screen_variance" in there or "compensate" in there:
        variance = there.get("screen_variance", CLASSIC.variance)
        values[FILTER] = {"variance": variance, "compensate": bool(there.get("compensate"))}
    return values


def _read_constants(path: Path, vertex: np.ndarray) -> dict[str, float]:
    """The value of each column whose name begins with ``clod_``, by ``_simplest``."""
    found = {}
    for name in vertex.dtype.names or ():
        if name.startswith(COLUMN) and len(vertex):
            values = vertex[name]
            if not (values == values[0]).all():
                raise ClodError(
                    f"{path}: property {name} must be one value for all rows and has several, so files of different "
                    "settings were merged; give one of them"
                )
            found[name] = _simplest(values[0])
    return found


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
