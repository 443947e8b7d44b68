"""What a file is, who wrote it as far as it tells, what is in it, and what an adaptation would make of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter.calibration import Calibration
from clod_adapter.config import CLASSIC, AdaptConfig, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.inspection.authorship import NERFSTUDIO, looks_like
from clod_adapter.inspection.statistics import FAR, Values, values_of
from clod_adapter.io.ply.columns import MASKS, SIGMA, column_map, read_table
from clod_adapter.io.ply.constants import PREFIX as CONSTANT
from clod_adapter.io.ply.constants import read_constants
from clod_adapter.io.ply.header import (
    PREFIX,
    Head,
    has_settings,
    read_attenuation,
    read_calibration,
    read_head,
    read_screen_filter,
)
from clod_adapter.io.ply.packed import is_packed
from clod_adapter.io.ply.values import FILTER, as_stored_by_inria, choice_of, in_question
from clod_adapter.io.readers import PLY, read_rows, reader_of
from clod_adapter.io.rows import Rows
from clod_adapter.io.screen_filter import likely
from clod_adapter.origin import Origin, origin_of

NORMALS = ("nx", "ny", "nz")


@dataclass(frozen=True)
class Oddity:
    """Something that most files do not have.

    Attributes:
        kind: one word, for scripts.
        count: Gaussians, or columns, that it is about; 0 where it is about the file.
        says: one line.
    """

    kind: str
    count: int
    says: str


@dataclass(frozen=True)
class Dial:
    """What a file with sigma_d says of it."""

    attenuation: AttenuationConfig
    calibration: Calibration | None


@dataclass(frozen=True)
class Splat:
    """A file of Gaussians.

    Attributes:
        sh_degree: that the file has room for; ``values.used_sh_degree`` is used.
        encoding: of a PLY: "binary little-endian", "binary big-endian" or "ascii".
        columns: the vertices' properties in the order of the file, with their types; of other formats none.
        extra: properties that mean nothing here and go along into outputs as they are.
        comments: of the header, without ours.
        tau: the threshold that ``values.fainter_than_tau`` is about: the dial's, or adapting's default.
        origin: what an adaptation reads the positions relative to, world units; 0 unless they are far from 0.
        screen_filter: that it is drawn with, as far as the file tells.
    """

    sh_degree: int
    encoding: str
    columns: tuple[tuple[str, str], ...]
    extra: tuple[str, ...]
    comments: tuple[str, ...]
    values: Values
    tau: float
    origin: Origin
    dial: Dial | None
    screen_filter: ScreenFilter


@dataclass(frozen=True)
class Inspection:
    """What ``inspect`` found.

    Attributes:
        path, size: the file, and its bytes.
        what: in a few words.
        writer: who wrote it, as far as it tells: a guess; None where nothing tells.
        splat: of Gaussians; of other kinds of file None.
        about: of an adapter or a training state: plain JSON.
        oddities: things that most files do not have.
        left_out: what adapting leaves out or does not touch, one line each.
        notes: what reading it says.
    """

    path: str
    size: int
    what: str
    writer: str | None
    splat: Splat | None
    about: dict[str, Any] | None
    oddities: tuple[Oddity, ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        found |= {"oddities": [asdict(oddity) for oddity in self.oddities], "splat": None}
        if self.splat is not None:
            rest = asdict(self.splat)
            values, dial = rest.pop("values"), rest.pop("dial")
            if dial is not None and dial["calibration"] is not None:
                dial["calibration"]["rows"] = list(dial["calibration"]["rows"])
            found["splat"] = {**rest, **values, "dial": dial}
        return found


def inspect(path: str | Path) -> Inspection:
    """Looks into a file: a splat in any format that ``load`` reads, an adapter, or the state of an interrupted run.

    Values that look activated are taken so, and said to be.

    Raises:
        ClodError: it is none of these (the message says what it is, where that can be told), damaged, or has no usable
            Gaussian.
    """
    path = Path(path)
    if path.suffix.lower() == ".safetensors":
        from clod_adapter.inspection.tensors import inspect_tensors

        if (found := inspect_tensors(path)) is not None:
            what, about = found
            return Inspection(str(path), path.stat().st_size, what, about["writer"], None, about, (), (), ())
    head = read_head(path) if reader_of(path) is PLY else None
    return _inspect_splat(path, read_rows(path), head)


def _inspect_splat(path: Path, rows: Rows, head: Head | None) -> Inspection:
    names = rows.vertex.dtype.names or ()
    constants = read_constants(path, rows.vertex) if SIGMA in names else {}
    said, expected = read_screen_filter(path, rows.comments, constants), likely(rows.comments, names)
    doubts = {} if rows.settled else in_question(rows.vertex)
    columns = _columns(head)
    vertex, _, changes = as_stored_by_inria(path, rows.vertex, choice_of(doubts))
    origin = origin_of(vertex) if rows.origin is None else rows.origin
    attenuation, notes = _reading(path, rows, vertex) if SIGMA in (vertex.dtype.names or ()) else (None, [])
    tau = attenuation.tau if attenuation else AdaptConfig().tau
    values = values_of(vertex, rows.sh_degree, origin, tau)
    if values is None:
        raise ClodError(f"{path}: no usable Gaussian in it, of {len(vertex)} rows; export it again")
    dial = None
    if attenuation is not None:
        calibration, remarks = read_calibration(rows.comments, values.count)
        dial, notes = Dial(attenuation, calibration), [*notes, *remarks]
    splat = Splat(
        sh_degree=rows.sh_degree, encoding=_encoding(head), columns=columns,
        extra=() if head and is_packed(head.ply) else _extra([name for name, _ in columns], rows.sh_degree),
        comments=tuple(comment for comment in rows.comments if not comment.startswith(PREFIX)), values=values, tau=tau,
        origin=origin, dial=dial, screen_filter=said or (CLASSIC if dial else expected),
    )  # fmt: skip
    writer = looks_like(head) if head else _writer(rows)
    if writer == NERFSTUDIO:
        notes = [*notes, "in nerfstudio's own frame: its dataparser_transforms.json belongs into the scene's folder"]
    return Inspection(
        path=str(path), size=path.stat().st_size, what=_what(path, rows, splat), writer=writer, splat=splat, about=None,
        oddities=tuple(_oddities(splat, doubts)), left_out=tuple(_left_out(splat, rows, changes)),
        notes=(*rows.notes, *notes),
    )  # fmt: skip


def _reading(path: Path, rows: Rows, vertex: np.ndarray) -> tuple[AttenuationConfig, list[str]]:
    """How sigma_d is read, and notes on that; ``vertex`` as ``as_stored_by_inria`` has made it."""
    attenuation, notes = read_attenuation(path, rows.comments, read_constants(path, vertex))
    if not has_settings(rows.comments):
        import torch  # here and not above, as most files have settings

        from clod_adapter.io.ply.plausible import judge

        table = torch.from_numpy(read_table(vertex, ("x", "y", "z", "opacity", SIGMA)))
        usable = table[table.isfinite().all(1)]
        if len(usable):
            notes += judge(usable[:, :3], usable[:, 3], usable[:, 4], attenuation)
    return attenuation, notes


def _columns(head: Head | None) -> tuple[tuple[str, str], ...]:
    """The vertices' properties and their types, as they are in the file."""
    found = head.ply["vertex"].properties if head else ()
    return tuple((column.name, str(np.dtype(column.val_dtype))) for column in found)


def _encoding(head: Head | None) -> str:
    if head is None:
        return ""
    return "ascii" if head.ply.text else f"binary {'little' if head.ply.byte_order in '<=' else 'big'}-endian"


def _what(path: Path, rows: Rows, splat: Splat) -> str:
    kind = "an adapted splat, with sigma_d" if splat.dial else "a splat"
    packed = any("quantised" in note for note in rows.notes)
    suffix = path.suffix.lower() or "PLY"
    return f"{kind}, {'compressed ' if packed else ''}{'PLY' if splat.encoding else suffix}"


def _writer(rows: Rows) -> str | None:
    return next((f"clod-adapter {c.split()[-1]}" for c in rows.comments if c.startswith(f"{PREFIX}version ")), None)


def _extra(names: Sequence[str], sh_degree: int) -> tuple[str, ...]:
    known = {name for group in column_map(sh_degree).values() for name in group}
    known |= {*NORMALS, SIGMA, *MASKS, FILTER}
    return tuple(name for name in names if name not in known and not name.startswith(CONSTANT))


def _oddities(splat: Splat, doubts: dict[str, tuple[float, float]]) -> list[Oddity]:
    v, found = splat.values, []

    def note(kind: str, count: int, says: str) -> None:
        if count:
            found.append(Oddity(kind, count, says.format(count=count)))

    for name, (low, high) in doubts.items():
        says = f"{name} from {low:.4g} to {high:.4g}: looks activated, and is taken so here; adapting asks"
        found.append(Oddity("activated", 0, f"{says} (--activated {choice_of(doubts)})"))
    for reason, gone in v.dropped.items():
        note("unusable", gone, f"{{count:,}} rows are not used: {reason}")
    note("infinite_opacity", v.infinite_opacity, "{count:,} have opacity = +inf, which is fully opaque")
    note("doubles", v.doubles, "{count:,} stand exactly where another does")
    note("far", v.far, f"{{count:,}} are {FAR:g} times as far out as nine tenths of the rest, or farther")
    note("giant", v.giant, "{count:,} are larger than half the scene")
    if splat.sh_degree and not v.used_sh_degree:
        note("empty_harmonics", 1, "all higher harmonics are 0: no view-dependent colour")
    if any(splat.origin):
        found.append(Oddity("far_from_0", 0, "the scene is far from 0: read relative to an origin of its own"))
    wide = [name for name, kind in splat.columns if kind == "float64"]
    note("double_precision", len(wide), f"{{count}} properties are double: {_list(wide)}")
    if splat.screen_filter.compensate:
        found.append(Oddity("antialiased", 0, f"trained antialiased, and drawn so: {splat.screen_filter.description}"))
    return found


def _left_out(splat: Splat, rows: Rows, changes: Sequence[str]) -> list[str]:
    v, lines = splat.values, []
    if gone := v.total - v.count:
        lines.append(f"{gone:,} of {v.total:,} rows, which cannot be used")
    lines += [note.removeprefix("not carried over to outputs: ") for note in rows.notes if "carried over" in note]
    if any(name == FILTER for name, _ in splat.columns):
        lines.append("filter_3D, which is fused into scale and opacity")
    if splat.sh_degree > v.used_sh_degree:
        lines.append(f"harmonics above degree {v.used_sh_degree}, which are 0: skipped in training, kept in the output")
    if splat.extra:
        lines.append(f"nothing of {_list(splat.extra)}: they go along as they are")
    return lines + [change for change in changes if "taken as activated" in change]


def _list(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
