"""PLY headers: parsed before the data is read; comments store the dial's settings and calibration."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

from plyfile import PlyData

from clod_adapter._support.version import package_version
from clod_adapter.calibration import Calibration, CalibrationRow, Viewpoint
from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.screen_filter import tagged
from clod_adapter.io.settings import FILTER
from clod_adapter.io.sniff import read_start, refuse

PREFIX = "clod_adapter "
# Comments of the calibration: machine; total, views, width, height, reference; one for each row and each viewpoint.
MACHINE, EXTENT, ROW, VIEWPOINT = "calibrated_on", "calibrated_with", "calibrated", "viewpoint"
HEADER_LIMIT = 1 << 20  # bytes


@dataclass(frozen=True)
class Head:
    """A PLY header.

    Attributes:
        ply: elements, properties and comments; every element has 0 rows.
        counts: the number of rows that the header states for each element, in order.
        size: bytes of the header; the data starts there.
    """

    ply: PlyData
    counts: tuple[int, ...]
    size: int


def read_head(path: Path) -> Head:
    """The header alone, so that a large mesh is refused without parsing its faces.

    Raises:
        ClodError: the file cannot be read, or as ``parse_head``.
    """
    return parse_head(path, read_start(path, HEADER_LIMIT))


def parse_head(path: Path, start: bytes) -> Head:
    """The header at the start of a file; allocates nothing for the rows that it states.

    Args:
        start: the first ``HEADER_LIMIT`` bytes of ``path``, or all where there are fewer.

    Raises:
        ClodError: the file is not a PLY, or its header is damaged or longer than ``HEADER_LIMIT``.
    """
    if not re.match(rb"ply\r?\n|ply\r", start):
        refuse(path, start)
    end = re.search(rb"[\r\n]end_header(\r?\n|\r)", start)
    if end is None:
        most = f" in its first {HEADER_LIMIT:,} bytes" if len(start) >= HEADER_LIMIT else ""
        raise ClodError(f"{path}: the PLY header has no end{most}, so the file is truncated; copy or export it again")
    header = re.sub(rb"\r\n?", b"\n", start[: end.end()])
    if re.search(rb"[^\t\n\x20-\x7e]", header):
        raise ClodError(
            f"{path}: the PLY header holds a character that is not printable ASCII; remove it from the comments"
        )
    counts = re.findall(rb"(?m)^[ \t]*element[ \t]+\S+[ \t]+(\d{1,20})[ \t]*$", header)
    header = re.sub(rb"(?m)^([ \t]*element[ \t]+\S+[ \t]+)\d{1,20}[ \t]*$", rb"\g<1>0", header)
    try:
        ply = PlyData.read(io.BytesIO(header), mmap=False)
    except Exception as error:  # plyfile raises ValueError and others besides its own errors
        raise ClodError(f"{path}: the PLY header is damaged ({error}); export the file again") from error
    if len(counts) != len(ply.elements):
        raise ClodError(f"{path}: the PLY header is damaged (a row count is not a number); export the file again")
    return Head(ply, tuple(map(int, counts)), end.end())


def all_comments(ply: PlyData) -> tuple[str, ...]:
    """All comments of the header: the file's, then each element's."""
    return (*ply.comments, *(comment for element in ply for comment in element.comments))


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

    Args:
        version: of the package that made the values; by default the running one.
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


def described(comments: Iterable[str]) -> bool:
    """Whether a comment of this package is there."""
    return any(comment.startswith(PREFIX) for comment in comments)


def stored_settings(comments: Iterable[str]) -> dict[str, Any]:
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
