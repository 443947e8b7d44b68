"""PLY headers: a look before the data is read, and the comments that carry the dial's settings and calibration."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

from plyfile import PlyData

from clod_adapter.calibration import AGAINST, Calibration, CalibrationRow, Viewpoint
from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.ply.constants import dial_settings, filter_of
from clod_adapter.io.regular import read_start
from clod_adapter.io.screen_filter import KEY, parse_words, tagged, words_of
from clod_adapter.io.settings import as_before, with_range
from clod_adapter.io.sniff import refuse
from clod_adapter.version import package_version

PREFIX = "clod_adapter "
# Comments about the calibration: the machine; total, views, width, height and what it is against; the rows, one
# comment each; and the viewpoints, one comment each.
MACHINE, EXTENT, ROW, VIEWPOINT = "calibrated_on", "calibrated_with", "calibrated", "viewpoint"
_HEADER_LIMIT = 1 << 20  # bytes; a longer header is no header


@dataclass(frozen=True)
class Head:
    """What stands before the data of a PLY.

    Attributes:
        ply: the elements, properties and comments; every element has 0 rows.
        counts: the rows that the elements are said to have, in their order.
        size: bytes; the data starts there.
    """

    ply: PlyData
    counts: tuple[int, ...]
    size: int


def read_head(path: Path) -> Head:
    """A look at a PLY before its data is read, which allocates nothing for it whatever it claims to hold.

    Raises:
        ClodError: the file cannot be read, is not a PLY, or its header is damaged or longer than 1 MB.
    """
    start = read_start(path, _HEADER_LIMIT)
    if not re.match(rb"ply\r?\n|ply\r", start):
        refuse(path, start)
    end = re.search(rb"[\r\n]end_header(\r?\n|\r)", start)
    if end is None:
        raise ClodError(f"{path}: the PLY header has no end, so the file is truncated; copy or export it again")
    header = re.sub(rb"\r\n?", b"\n", start[: end.end()])
    if re.search(rb"[^\t\n\x20-\x7e]", header):
        raise ClodError(
            f"{path}: the PLY header holds a character that is not printable ASCII; remove it from the comments"
        )
    counts = re.findall(rb"(?m)^[ \t]*element[ \t]+\S+[ \t]+(\d{1,20})[ \t]*$", header)
    header = re.sub(rb"(?m)^([ \t]*element[ \t]+\S+[ \t]+)\d{1,20}[ \t]*$", rb"\g<1>0", header)
    try:
        ply = PlyData.read(io.BytesIO(header), mmap=False)
    except Exception as error:  # plyfile lets ValueError and more through, besides its own errors
        raise ClodError(f"{path}: the PLY header is damaged ({error}); export the file again") from error
    if len(counts) != len(ply.elements):
        raise ClodError(f"{path}: the PLY header is damaged (a count of rows is no number); export the file again")
    return Head(ply, tuple(map(int, counts)), end.end())


def read_header(path: Path) -> PlyData:
    """The elements, properties and comments of a PLY without its data; every element has 0 rows.

    A large mesh given by mistake is so refused at once instead of after minutes of parsing faces.

    Raises:
        ClodError: as ``read_head``.
    """
    return read_head(path).ply


def all_comments(ply: PlyData) -> tuple[str, ...]:
    """Every comment of the header: the file's own, then each element's."""
    return (*ply.comments, *(comment for element in ply for comment in element.comments))


def write_comments(
    config: AttenuationConfig | None,
    inherited: Iterable[str],
    version: str | None = None,
    calibration: Calibration | None = None,
    screen_filter: ScreenFilter = CLASSIC,
) -> list[str]:
    """The comments of an output: the base's, then ours, which replace any the base had.

    One comment per field of ``config``, as ``clod_adapter tau 0.00392156862745098``: the shortest
    decimal that gives back the same double. Before them the ``version`` that made the values, by default this one;
    after them the screen-space filter, if it is not the usual one, and the calibration, one short line for each row, as
    some readers do not take long ones.
    """
    comments = tagged([comment for comment in inherited if not comment.startswith(PREFIX)], screen_filter)
    comments.append(f"{PREFIX}version {version or package_version()}")
    for field in fields(config) if config is not None else ():
        value = getattr(config, field.name)
        kind: Any = type(field.default)
        comments.append(f"{PREFIX}{field.name} {value if value is None else kind(value)}")
    comments += [f"{PREFIX}{words}" for words in words_of(screen_filter)]
    if calibration is not None:
        c = calibration
        comments.append(f"{PREFIX}{MACHINE} {c.machine}")
        comments.append(f"{PREFIX}{EXTENT} {c.total} {c.views} {c.width} {c.height} {c.against}")
        for name, lines in ((ROW, c.rows), (VIEWPOINT, c.viewpoints)):
            comments += [f"{PREFIX}{name} {' '.join(map(repr, astuple(line)))}" for line in lines]
    return comments


def read_calibration(comments: Iterable[str], total: int) -> tuple[Calibration | None, list[str]]:
    """The calibration table in the header's comments, if it is one of ``total`` Gaussians, and a note if it is not.

    A table that is damaged or of other rows is no reason to refuse the file: the picture does not need it.
    """
    found: dict[str, list[list[str]]] = {MACHINE: [], EXTENT: [], ROW: [], VIEWPOINT: []}
    for words in (comment[len(PREFIX) :].split() for comment in comments if comment.startswith(PREFIX)):
        if words and words[0] in found:
            found[words[0]].append(words[1:])
    if not any(found.values()):
        return None, []
    try:
        (machine,), (extent,) = found[MACHINE], found[EXTENT]
        counts = dict(zip(("total", "views", "width", "height"), map(int, extent[:4]), strict=True))
        rows = tuple(CalibrationRow(*map(float, row)) for row in found[ROW])
        against = " ".join(extent[4:]) or AGAINST[0]  # files that do not say are of before there was another
        viewpoints = tuple(Viewpoint(*map(float, place)) for place in found[VIEWPOINT])
        calibration = Calibration(
            rows, **counts, machine=" ".join(machine), against=against, viewpoints=viewpoints
        )  # fmt: skip
    except (TypeError, ValueError, ClodError) as error:
        return None, [f"the calibration in the header is unusable and ignored ({error})"]
    if calibration.total != total:
        return None, [
            f"the calibration in the header is of {calibration.total} Gaussians and ignored, these are {total}"
        ]
    return calibration, []


def read_attenuation(
    path: Path, comments: Iterable[str], constants: Mapping[str, float] | None = None
) -> tuple[AttenuationConfig, list[str]]:
    """The settings in the header's comments, else in columns, and notes on them.

    What neither has is the default; in a file with comments of ours, which an earlier version wrote, what was the
    default then (``silence.BEFORE``).

    Args:
        constants: from ``ply_constants.read_constants``.

    Raises:
        ClodError: a comment of ours, or a column, holds a value that is no setting.
    """
    ours = [comment[len(PREFIX) :].split(maxsplit=1) for comment in comments if comment.startswith(PREFIX)]
    stored = {words[0]: words[1].strip() for words in ours if len(words) == 2}
    for other in ("version", MACHINE, EXTENT, ROW, VIEWPOINT, KEY):
        stored.pop(other, None)
    kinds = {field.name: type(field.default) for field in fields(AttenuationConfig)}
    try:
        values = {name: _parse(stored[name], kind) for name, kind in kinds.items() if name in stored}
        known = dial_settings(constants or {}) | values
        notes = [f"settings of the dial read from columns: {', '.join(known)}"] if known and not values else []
        if ours:
            known, notes = as_before(known)
        if unknown := [name for name in stored if name not in kinds]:
            notes.append(f"settings unknown to this version ignored: {', '.join(unknown)}")
        return with_range(known), notes
    except (ValueError, ClodError) as error:
        what = "header comment" if ours else "column"
        raise ClodError(f"{path}: a clod_adapter {what} is unusable ({error}); restore or remove it") from error


def read_screen_filter(
    path: Path, comments: Iterable[str], constants: Mapping[str, float] | None = None
) -> ScreenFilter | None:
    """The filter that the Gaussians were trained with, by our comments, else by columns; None where neither tells.

    Args:
        constants: from ``ply_constants.read_constants``.

    Raises:
        ClodError: a comment of ours, or a column, holds a value that is no setting.
    """
    start = f"{PREFIX}{KEY}"
    said = [comment.removeprefix(start) for comment in comments if re.match(rf"{start}\b", comment)]
    try:
        return parse_words(said[-1]) if said else filter_of(constants or {})
    except (ValueError, ClodError) as error:
        what = "header comment" if said else "column"
        raise ClodError(f"{path}: a clod_adapter {what} is unusable ({error}); restore or remove it") from error


def _parse(text: str, kind: type) -> Any:
    if text == "None":
        return None
    return text == "True" if kind is bool else kind(text)


def has_settings(comments: Iterable[str]) -> bool:
    """Whether there is a comment of ours, so that the file says by which settings its sigma_d is to be read."""
    return any(comment.startswith(PREFIX) for comment in comments)
