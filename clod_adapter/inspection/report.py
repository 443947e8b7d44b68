"""Inspection of a file: its kind, its probable writer, its contents, and what adapting would leave out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter.calibration import Calibration
from clod_adapter.config import SH_COUNTS, AdaptConfig, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.inspection.authorship import NERFSTUDIO, looks_like
from clod_adapter.inspection.statistics import FAR, Spread, Values, values_of
from clod_adapter.io.file_formats import read_source
from clod_adapter.io.ply import MASK_COLUMNS
from clod_adapter.io.ply_layout import COLUMN, PREFIX, column_map
from clod_adapter.io.ply_packed import is_packed
from clod_adapter.io.settings import ADAPTER, matching_calibration, stated_filter
from clod_adapter.io.values import FILTER, choice_of, dial_columns, in_question, prepared
from clod_adapter.origin import Origin

NORMALS = ("nx", "ny", "nz")


@dataclass(frozen=True)
class Anomaly:
    """A property that most files do not have."""

    kind: str  # one word, for scripts
    count: int  # of Gaussians or columns; 0 for the whole file
    says: str


@dataclass(frozen=True)
class Dial:
    """The settings of a file with a dial."""

    attenuation: AttenuationConfig
    calibration: Calibration | None


@dataclass(frozen=True)
class Splat(Values):
    """A file of Gaussians, and the statistics of its rows."""

    sh_degree: int
    encoding: str  # of a PLY
    columns: tuple[tuple[str, str], ...]  # the properties of a PLY in its order, with their types
    extra: tuple[str, ...]  # properties without a meaning here, copied to outputs unchanged
    comments: tuple[str, ...]  # of the header, without ours
    tau: float  # of ``fainter_than_tau``: the dial's, or the default of adapting
    origin: Origin
    dial: Dial | None
    screen_filter: ScreenFilter

    @property
    def dial_columns(self) -> str:
        """The columns of the dial, of a file that has one."""
        return "sigma_d" if self.growth is None else "sigma_d and growth_d"


@dataclass(frozen=True)
class Inspection:
    """The result of ``inspect``."""

    path: str
    size: int
    what: str  # the kind of file, in a few words
    writer: str | None  # the program that probably wrote it
    notes: tuple[str, ...]  # of the reader
    splat: Splat | None = None
    about: dict[str, Any] | None = None  # of an adapter or a training state
    anomalies: tuple[Anomaly, ...] = ()
    left_out: tuple[str, ...] = ()  # what adapting leaves out or does not change, one line each

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        found = asdict(self)
        return {**found, "oddities": found.pop("anomalies")}


def inspect(path: str | Path) -> Inspection:
    """Inspects a splat in any format that ``load`` reads, an adapter, or the state of an interrupted run."""
    path = Path(path)
    if path.suffix.lower() == ".safetensors" and (found := _inspect_tensors(path)):
        return found
    source = read_source(path)
    metadata, head, notes = source.metadata, source.head, [*source.notes, *source.metadata.notes]
    questions = in_question(source.arrays) if source.activation_unknown else {}
    rows = prepared(path, source.arrays, choice_of(questions), metadata.origin, None)
    if not rows.keep.any():
        raise ClodError(f"{path}: no usable Gaussian in it, of {len(rows.keep)} rows; export it again")
    tau = metadata.attenuation.tau if metadata.attenuation else AdaptConfig().tau
    values, dial = values_of(rows, tau), None
    if metadata.attenuation is not None:
        calibration, mismatch = matching_calibration(metadata, values["count"])
        dial = Dial(metadata.attenuation, calibration)
        if not metadata.described:
            from clod_adapter.io.checkpoint import plausibility  # here: other files are inspected without torch

            part = {name: rows.arrays[name][rows.keep] for name in ("means", "opacity_logits", "sigma_d")}
            notes += plausibility(part, metadata.attenuation)
        notes += mismatch
    degree, encoding = next(d for d, n in SH_COUNTS.items() if n == rows.arrays["shN"].shape[1] + 1), ""
    columns: tuple[tuple[str, str], ...] = ()
    if head:
        columns = tuple((column.name, str(np.dtype(column.val_dtype))) for column in head.ply["vertex"].properties)
        order = "little" if head.ply.byte_order in "<=" else "big"
        encoding = "ascii" if head.ply.text else f"binary {order}-endian"
    splat = Splat(
        **values, sh_degree=degree, encoding=encoding, columns=columns,
        extra=() if head and is_packed(head.ply) else extra_columns([name for name, _ in columns], degree),
        comments=tuple(comment for comment in source.comments if not comment.startswith(PREFIX)), tau=tau,
        origin=rows.origin, dial=dial, screen_filter=stated_filter(source),
    )  # fmt: skip
    writer = looks_like(head) if head else f"clod-adapter {metadata.version}" if metadata.version else None
    if writer == NERFSTUDIO:
        notes.append("in nerfstudio's own frame: its dataparser_transforms.json belongs in the scene's folder")
    kind = f"an adapted splat, with {splat.dial_columns}" if splat.dial else "a splat"
    packed = "compressed " * any("quantised" in note for note in source.notes)
    what = f"{kind}, {packed}{'PLY' if head else path.suffix.lower()}"
    return Inspection(
        str(path), path.stat().st_size, what, writer, tuple(notes), splat, anomalies=anomalies_of(splat, questions),
        left_out=left_out_of(splat, source.notes, rows.changes),
    )  # fmt: skip


def extra_columns(names: Sequence[str], sh_degree: int) -> tuple[str, ...]:
    """The properties of a PLY without a meaning here."""
    known = {name for group in column_map(sh_degree).values() for name in group}
    known |= {*NORMALS, *dial_columns(names), *MASK_COLUMNS, FILTER}
    return tuple(name for name in names if name not in known and not name.startswith(COLUMN))


def anomalies_of(splat: Splat, questions: dict[str, tuple[float, float]]) -> tuple[Anomaly, ...]:
    """The anomalies of a file; ``questions`` are the ranges of columns that look activated, by name."""
    counted = [("unusable", gone, f"rows are not used: {reason}") for reason, gone in splat.dropped.items()]
    counted += [
        ("infinite_opacity", splat.infinite_opacity, "have opacity = +inf, which is fully opaque"),
        ("doubles", splat.doubles, "have the same position as another Gaussian"),
        ("far", splat.far, f"are at least {FAR:g} times as far from the centre as 90 % of all"),
        ("giant", splat.giant, "are larger than half the scene"),
    ]
    found = [Anomaly(kind, count, f"{count:,} {says}") for kind, count, says in counted if count]
    for name, (low, high) in questions.items():
        says = f"{name} from {low:.4g} to {high:.4g}: looks activated, and is read as activated here; adapting needs"
        found.append(Anomaly("activated", 0, f"{says} --activated {choice_of(questions)}"))
    if any(splat.origin):
        found.append(Anomaly("far_from_0", 0, "coordinates are far from 0; they are read relative to a local origin"))
    if splat.screen_filter.compensate:
        found.append(Anomaly("antialiased", 0, f"trained with antialiasing: {splat.screen_filter.description}"))
    return tuple(found)


def left_out_of(splat: Splat, notes: Sequence[str], changes: Sequence[str]) -> tuple[str, ...]:
    """Parts that adapting leaves out or does not change, a line each, from the reader's notes and changes."""
    lines, used = [], splat.used_sh_degree
    if gone := splat.total - splat.count:
        lines.append(f"{gone:,} of {splat.total:,} rows, which are not usable")
    lines += [note.removeprefix("not carried over to outputs: ") for note in notes if "carried over" in note]
    if any(name == FILTER for name, _ in splat.columns):
        lines.append("filter_3D, which is merged into scale and opacity")
    if splat.sh_degree > used:
        lines.append(f"harmonics above degree {used}, which are 0: skipped in training, kept in the output")
    if splat.extra:
        more = f" and {len(splat.extra) - 6} more" * (len(splat.extra) > 6)
        lines.append(f"{', '.join(splat.extra[:6])}{more}: not used, copied to outputs")
    return (*lines, *(change for change in changes if "taken as activated" in change))


def _inspect_tensors(path: Path) -> Inspection | None:
    """Inspects an adapter or a state; None where it is neither."""
    from clod_adapter.io.adapter_file import load_adapter
    from clod_adapter.io.file_formats import KEY
    from clod_adapter.io.tensor_file import read_tensor_header
    from clod_adapter.training.state import KEY as STATE_KEY
    from clod_adapter.training.state import load_state

    size, metadata = path.stat().st_size, read_tensor_header(path)[1]
    if STATE_KEY in metadata:
        state, belongs = load_state(path)
        count = next((len(t) for t in state.tensors.values() if t.ndim), 0)
        about = {
            "kind": "state", "writer": None, "count": count, "steps": state.steps, "seconds": state.seconds,
            "loss": state.loss, "belongs": belongs, "attenuation": state.attenuation,
        }  # fmt: skip
        return Inspection(str(path), size, "the state of an interrupted run, for --resume", None, (), about=about)
    if KEY not in metadata or f'"{ADAPTER}"' not in metadata[KEY]:
        return None
    adapter = load_adapter(path)
    kinds = {name: f"{str(t.dtype).removeprefix('torch.')} {list(t.shape)}" for name, t in adapter.updates.items()}
    growth = None if adapter.growth_d is None else Spread.of(adapter.growth_d.numpy())
    writer, what = f"clod-adapter {adapter.version}", "an adapter: what clod-adapt learned, without its checkpoint"
    return Inspection(str(path), size, what, writer, adapter.notes, about={
        "kind": "adapter", "writer": writer, "count": len(adapter.sigma_d),
        "base": adapter.base_fingerprint, "attenuation": adapter.attenuation, "config": adapter.config,
        "updates": kinds, "origin": list(adapter.origin), "sigma": Spread.of(adapter.sigma_d.numpy()),
        "growth": growth, "calibration": adapter.calibration,
    })  # fmt: skip
