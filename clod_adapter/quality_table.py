"""The quality table of a file, stored in it, with cameras by which a dial value is baked
without photographs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields, replace
from typing import Any

from clod_adapter.config import FARTHEST, require
from clod_adapter.errors import ClodError

AGAINST = ("photographs", "checkpoint")
# Every file has room for so many.
MOST_ENTRIES = 1000  # rows and viewpoints
LONGEST_MACHINE = 1000  # characters of the machine's name
LARGEST = 1 << 32  # count
PIXELS = 1 << 26  # of an image: a page renders images of this size


@dataclass(frozen=True)
class QualityRow:
    """Means over the held-out views: Gaussians kept, PSNR in dB and SSIM, and the median
    milliseconds of a frame.
    """

    virtual_scale: float
    kept: float
    psnr: float
    ssim: float
    frame_ms: float


@dataclass(frozen=True)
class Viewpoint:
    """A camera as stored with the file: what the equation uses, and for viewers where it looks.

    Attributes:
        x, y, z: the camera's centre, world units.
        unit: the divisor D of distances from there, world units, > 0.
        look_x, look_y, look_z: unit vector of its optical axis; 0 in files of earlier versions.
        up_x, up_y, up_z: unit vector to the upper edge of its image.
        fov: vertical angle of view, radians; 0 if unknown.

    Raises:
        ClodError: a value is out of range, or a vector is no unit vector.
    """

    x: float
    y: float
    z: float
    unit: float
    look_x: float = 0.0
    look_y: float = 0.0
    look_z: float = 0.0
    up_x: float = 0.0
    up_y: float = 0.0
    up_z: float = 0.0
    fov: float = 0.0

    def __post_init__(self) -> None:
        values = astuple(self)
        centre = values[:3]
        direction = values[4:]
        near = max(map(abs, centre)) < FARTHEST and not math.isnan(sum(centre))
        require(near, "the centre of a viewpoint", centre, f"below {FARTHEST:g}")
        look = math.hypot(*direction[:3])
        up = math.hypot(*direction[3:6])
        units = abs(look - 1) < 1e-3 and abs(up - 1) < 1e-3
        sound = not any(direction) or (units and 1e-4 < self.fov < math.pi)
        require(sound, "the direction of a viewpoint", direction, "unit vectors and an angle")
        sound = 0 < self.unit < math.inf
        require(sound, "the unit of a viewpoint", self.unit, "positive and finite")

    def moved(self, by: Sequence[float]) -> Viewpoint:
        """A copy with its centre moved by ``by [3]``, world units."""
        x, y, z = by
        return replace(self, x=self.x + x, y=self.y + y, z=self.z + z)


@dataclass(frozen=True)
class QualityTable:
    """Count, quality and frame time at ascending dial values, the first s = 1, and how they were
    measured.

    Attributes:
        rows: at least one.
        total: number of Gaussians in the file; a file with another number does not match the table.
        views: number of held-out views that the rows average over.
        width, height: image size in pixels.
        machine: where the frame times were measured, one line of printable ASCII.
        against: reference of PSNR and SSIM: the ``photographs``, or without any, renders of the
            ``checkpoint``.
        viewpoints: of some training cameras, in the file's coordinates; empty in files of earlier
            versions.

    Raises:
        ClodError: a field is out of range, or dial values do not ascend from 1.
    """

    rows: tuple[QualityRow, ...]
    total: int
    views: int
    width: int
    height: int
    machine: str
    against: str = "photographs"
    viewpoints: tuple[Viewpoint, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "viewpoints", tuple(self.viewpoints))
        dials = [row.virtual_scale for row in self.rows]
        if dials[:1] != [1] or dials != sorted(set(dials)):
            raise ClodError(f"quality table has dial values {dials}, they must ascend from 1")
        for row in self.rows:
            if not all(map(math.isfinite, astuple(row))) or row.frame_ms <= 0:
                raise ClodError(f"quality table has a value out of range: {row}")
        counts = (self.total, self.views, self.width, self.height)
        entries = len(self.rows) + len(self.viewpoints)
        sound = min(counts) >= 1 and max(counts) <= LARGEST
        if not sound or self.width * self.height > PIXELS or entries > MOST_ENTRIES:
            raise ClodError(f"quality table has a count or size out of range: {(*counts, entries)}")
        if not self.machine.isascii() or self.machine != _plain(self.machine) or not self.machine:
            raise ClodError(
                f"the machine of a quality table is {self.machine!r}, it must be one line of"
                " printable ASCII"
            )
        known = ", ".join(AGAINST)
        require(self.against in AGAINST, "against", repr(self.against), f"one of {known}")

    @classmethod
    def of(
        cls, rows: Iterable[Any], *, size: tuple[int, int], machine: str, **others: Any
    ) -> QualityTable:
        """The table of an evaluation's rows (``evaluate.Row``) for images of ``size`` (width,
        height).

        Rows may be in any order, and the machine's name any text; the other fields are passed on.
        """
        by_dial = {}
        for row in sorted(rows, key=lambda row: row.virtual_scale):
            values = {each.name: float(getattr(row, each.name)) for each in fields(QualityRow)}
            by_dial[row.virtual_scale] = QualityRow(**values)
        name = _plain(machine.encode("ascii", "replace").decode()) or "unknown"
        width, height = size
        return cls(tuple(by_dial.values()), width=width, height=height, machine=name, **others)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> QualityTable:
        """The inverse of ``as_dict``; ClodError, KeyError, TypeError or ValueError where it is
        none.
        """
        rows = tuple(QualityRow(**_floats(row)) for row in values["rows"])
        counts = {name: int(values[name]) for name in ("total", "views", "width", "height")}
        # files of earlier versions have no such key
        against = str(values.get("against", AGAINST[0]))
        viewpoints = tuple(Viewpoint(**_floats(row)) for row in values.get("viewpoints", ()))
        return cls(
            rows,
            machine=str(values["machine"]),
            against=against,
            viewpoints=viewpoints,
            **counts,
        )

    def as_dict(self) -> dict[str, Any]:
        """The table as plain JSON values."""
        return vars(self) | {
            "rows": [dict(vars(row)) for row in self.rows],
            "viewpoints": [dict(vars(viewpoint)) for viewpoint in self.viewpoints],
        }


def crossing(dials: Sequence[float], values: Sequence[float], target: float) -> float | None:
    """The smallest dial value from which on ``values``, linear in log s, are at most ``target``;
    None if none is.
    """
    above = [k for k, value in enumerate(values) if value > target]
    if not above:
        return dials[0]
    last = above[-1]
    if last == len(values) - 1:
        return None
    share = (values[last] - target) / (values[last] - values[last + 1])
    return dials[last] * (dials[last + 1] / dials[last]) ** share


def _floats(row: dict[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in row.items()}


def _plain(text: str) -> str:
    printable = "".join(letter if letter.isprintable() else " " for letter in text)
    return " ".join(printable.split())[:LONGEST_MACHINE].strip()
