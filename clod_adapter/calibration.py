"""The calibration table of a file, stored in it, with cameras by which a dial value is baked
without photographs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import chain, pairwise
from typing import Any

from clod_adapter.config import FARTHEST, require
from clod_adapter.errors import ClodError

AGAINST = ("photographs", "checkpoint")
# Every file has room for so many.
MOST_ENTRIES = 1000  # rows and viewpoints
LONGEST_MACHINE = 1000  # characters of the machine's name
NARROWEST = 1e-4  # angle of view, radians
LARGEST = 1 << 32  # count
PIXELS = 1 << 26  # of an image: a page renders images of this size


@dataclass(frozen=True)
class CalibrationRow:
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
        near = all(abs(value) < FARTHEST for value in values[:3])
        require(near, "the centre of a viewpoint", values[:3], f"below {FARTHEST:g}")
        lengths = math.hypot(*values[4:7]), math.hypot(*values[7:10])
        units = max(abs(length - 1) for length in lengths) < 1e-3
        has_direction = units and NARROWEST < self.fov < math.pi
        require(
            has_direction or not any(values[4:]),
            "the direction of a viewpoint",
            values[4:],
            "unit vectors and an angle",
        )
        require(
            0 < self.unit < math.inf, "the unit of a viewpoint", self.unit, "positive and finite"
        )

    def moved(self, by: Sequence[float]) -> Viewpoint:
        """A copy with its centre moved by ``by [3]``, world units."""
        return replace(self, x=self.x + by[0], y=self.y + by[1], z=self.z + by[2])


@dataclass(frozen=True)
class Calibration:
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

    rows: tuple[CalibrationRow, ...]
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
        if dials[:1] != [1] or any(b <= a for a, b in pairwise(dials)):
            raise ClodError(f"calibration has dial values {dials}, they must ascend from 1")
        if not all(map(math.isfinite, chain.from_iterable(map(astuple, self.rows)))):
            raise ClodError("calibration has a value that is not finite")
        counts = self.total, self.views, self.width, self.height
        if min(counts) < 1 or min(row.frame_ms for row in self.rows) <= 0:
            raise ClodError("calibration has a count, size or frame time that is not positive")
        require(
            max(counts) <= LARGEST,
            "a count or size of a calibration",
            max(counts),
            f"at most {LARGEST}",
        )
        size = f"{self.width}x{self.height}"
        require(
            self.width * self.height <= PIXELS,
            "the image of a calibration",
            size,
            f"at most {PIXELS} pixels",
        )
        entries = len(self.rows) + len(self.viewpoints)
        limit = f"at most {MOST_ENTRIES}"
        require(entries <= MOST_ENTRIES, "the number of rows and viewpoints", entries, limit)
        plain = self.machine.isascii() and self.machine == _plain(self.machine) != ""
        require(
            plain, "the machine of a calibration", repr(self.machine), "one line of printable ASCII"
        )
        if self.against not in AGAINST:
            raise ClodError(
                f"calibration is against {self.against!r}, it must be one of {', '.join(AGAINST)}"
            )

    @classmethod
    def of(
        cls, rows: Iterable[Any], *, size: tuple[int, int], machine: str, **others: Any
    ) -> Calibration:
        """The table of an evaluation's rows (``evaluate.Row``) for images of ``size`` (width,
        height).

        Rows may be in any order, and the machine's name any text; the other fields are passed on.
        """
        by_dial = {}
        for row in sorted(rows, key=lambda row: row.virtual_scale):
            values = row.virtual_scale, row.kept, row.psnr, row.ssim, row.frame_ms
            by_dial[float(row.virtual_scale)] = CalibrationRow(*map(float, values))
        name = _plain(machine.encode("ascii", "replace").decode()) or "unknown"
        width, height = size
        rows = tuple(by_dial.values())
        return cls(rows, width=width, height=height, machine=name, **others)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Calibration:
        """The inverse of ``as_dict``; ClodError, KeyError, TypeError or ValueError where it is
        none.
        """
        rows = tuple(CalibrationRow(**_floats(row)) for row in values["rows"])
        counts = {name: int(values[name]) for name in ("total", "views", "width", "height")}
        # files of earlier versions have no such key
        against = str(values.get("against", AGAINST[0]))
        viewpoints = tuple(Viewpoint(**_floats(row)) for row in values.get("viewpoints", ()))
        return cls(
            rows, machine=str(values["machine"]), against=against, viewpoints=viewpoints, **counts
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
