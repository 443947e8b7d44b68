"""Inspection of a file: its kind, its probable writer, its contents, and what adapting would leave out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter.config import CLASSIC, AdaptConfig, AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.inspection.authorship import NERFSTUDIO, looks_like
from clod_adapter.inspection.splat import Anomaly, Dial, Splat, anomalies_of, left_out_of
from clod_adapter.inspection.statistics import values_of
from clod_adapter.io.file_formats import PLY, Model, format_of, read_model
from clod_adapter.io.ply.columns import MASKS, SIGMA, column_map, dial_columns, read_table, rows_of
from clod_adapter.io.ply.constants import PREFIX as CONSTANT
from clod_adapter.io.ply.header import PREFIX, Head
from clod_adapter.io.ply.packed import is_packed
from clod_adapter.io.ply.rows import PlyRows, read_ply
from clod_adapter.io.ply.values import FILTER, as_stored_by_inria, choice_of, in_question
from clod_adapter.io.screen_filter import implied_filter
from clod_adapter.io.settings import matching_calibration
from clod_adapter.origin import origin_of

NORMALS = ("nx", "ny", "nz")


@dataclass(frozen=True)
class Inspection:
    """The result of ``inspect``.

    Attributes:
        path, size: the file, and its bytes.
        what: the kind of file, in a few words.
        writer: the program that probably wrote it; None where it cannot be told.
        splat: of a file of Gaussians; else None.
        about: of an adapter or a training state, plain JSON; else None.
        anomalies: properties that most files do not have.
        left_out: what adapting leaves out or does not change, one line each.
        notes: of the reader.
    """

    path: str
    size: int
    what: str
    writer: str | None
    splat: Splat | None
    about: dict[str, Any] | None
    anomalies: tuple[Anomaly, ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        found["oddities"] = [asdict(anomaly) for anomaly in found.pop("anomalies")]
        found["splat"] = None
        if self.splat is not None:
            rest = asdict(self.splat)
            values, dial = rest.pop("values"), rest.pop("dial")
            if dial is not None and dial["calibration"] is not None:
                dial["calibration"]["rows"] = list(dial["calibration"]["rows"])
            found["splat"] = {**rest, **values, "dial": dial}
        return found


def inspect(path: str | Path) -> Inspection:
    """Inspects a splat in any format that ``load`` reads, an adapter, or the state of an interrupted run.

    Values that look activated are taken as activated, and an anomaly states that.

    Raises:
        ClodError: the file is none of these, damaged, or has no usable Gaussian.
    """
    path = Path(path)
    if path.suffix.lower() == ".safetensors":
        from clod_adapter.inspection.tensors import inspect_tensors

        if (found := inspect_tensors(path)) is not None:
            what, about, notes = found
            return Inspection(str(path), path.stat().st_size, what, about["writer"], None, about, (), (), notes)
    if format_of(path) is PLY:
        rows = read_ply(path)
        return _inspect_splat(path, rows, rows.vertex, rows.sh_degree, rows.head)
    model = read_model(path)
    vertex = rows_of(
        {name: tensor.numpy() for name, tensor in model.gaussians.tensors().items()}, model.metadata.origin
    )
    return _inspect_splat(path, model, vertex, model.gaussians.sh_degree, None)


def _inspect_splat(
    path: Path, source: PlyRows | Model, vertex: np.ndarray, sh_degree: int, head: Head | None
) -> Inspection:
    metadata, notes, names = source.metadata, list(source.notes), vertex.dtype.names or ()
    implied = implied_filter(source.comments, names) if isinstance(source, PlyRows) else source.gaussians.screen_filter
    questions = in_question(vertex) if source.activation_unknown else {}
    vertex, _, changes = as_stored_by_inria(path, vertex, choice_of(questions))
    origin = metadata.origin if any(metadata.origin) else origin_of(vertex)
    tau = metadata.attenuation.tau if metadata.attenuation else AdaptConfig().tau
    values = values_of(vertex, sh_degree, origin, tau)
    if values is None:
        raise ClodError(f"{path}: no usable Gaussian in it, of {len(vertex)} rows; export it again")
    dial, notes = None, [*notes, *metadata.notes]
    if metadata.attenuation is not None:
        calibration, mismatch = matching_calibration(metadata, values.count)
        dial = Dial(metadata.attenuation, calibration)
        notes += [*([] if metadata.described else _plausible(vertex, dial.attenuation)), *mismatch]
    columns = _columns(head)
    comments = source.comments if isinstance(source, PlyRows) else metadata.about
    splat = Splat(
        sh_degree=sh_degree, encoding=_encoding(head), columns=columns,
        extra=() if head and is_packed(head.ply) else _extra([name for name, _ in columns], sh_degree),
        comments=tuple(comment for comment in comments if not comment.startswith(PREFIX)), values=values, tau=tau,
        origin=origin, dial=dial, screen_filter=metadata.screen_filter or (CLASSIC if dial else implied),
    )  # fmt: skip
    writer = looks_like(head) if head else f"clod-adapter {metadata.version}" if metadata.version else None
    if writer == NERFSTUDIO:
        notes = [*notes, "in nerfstudio's own frame: its dataparser_transforms.json belongs in the scene's folder"]
    return Inspection(
        path=str(path), size=path.stat().st_size, what=_what(path, source, splat), writer=writer, splat=splat,
        about=None, anomalies=tuple(anomalies_of(splat, questions)),
        left_out=tuple(left_out_of(splat, source.notes, changes)), notes=tuple(notes),
    )  # fmt: skip


def _plausible(vertex: np.ndarray, attenuation: AttenuationConfig) -> list[str]:
    """Notes on a dial without settings; ``vertex`` as ``as_stored_by_inria`` gives it."""
    import torch  # here: most files have settings

    from clod_adapter.io.ply.plausible import check_plausible

    table = torch.from_numpy(read_table(vertex, ("x", "y", "z", "opacity", SIGMA)))
    usable = table[table.isfinite().all(1)]
    return check_plausible(usable[:, :3], usable[:, 3], usable[:, 4], attenuation) if len(usable) else []


def _columns(head: Head | None) -> tuple[tuple[str, str], ...]:
    """The vertices' properties and their types, as they are in the file."""
    found = head.ply["vertex"].properties if head else ()
    return tuple((column.name, str(np.dtype(column.val_dtype))) for column in found)


def _encoding(head: Head | None) -> str:
    if head is None:
        return ""
    return "ascii" if head.ply.text else f"binary {'little' if head.ply.byte_order in '<=' else 'big'}-endian"


def _what(path: Path, source: PlyRows | Model, splat: Splat) -> str:
    kind = f"an adapted splat, with {splat.dial_columns}" if splat.dial else "a splat"
    packed = any("quantised" in note for note in source.notes)
    suffix = path.suffix.lower() or "PLY"
    return f"{kind}, {'compressed ' if packed else ''}{'PLY' if splat.encoding else suffix}"


def _extra(names: Sequence[str], sh_degree: int) -> tuple[str, ...]:
    known = {name for group in column_map(sh_degree).values() for name in group}
    known |= {*NORMALS, *dial_columns(names), *MASKS, FILTER}
    return tuple(name for name in names if name not in known and not name.startswith(CONSTANT))
