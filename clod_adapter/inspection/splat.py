"""The contents of a file of Gaussians: its properties, its anomalies, and what adapting leaves out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from clod_adapter.calibration import Calibration
from clod_adapter.config import AttenuationConfig, ScreenFilter
from clod_adapter.inspection.statistics import FAR, Values
from clod_adapter.io.ply.values import FILTER, choice_of
from clod_adapter.origin import Origin


@dataclass(frozen=True)
class Anomaly:
    """A property that most files do not have.

    Attributes:
        kind: one word, for scripts.
        count: of Gaussians or columns; 0 for the whole file.
        says: one line.
    """

    kind: str
    count: int
    says: str


@dataclass(frozen=True)
class Dial:
    """The settings of a file with a dial."""

    attenuation: AttenuationConfig
    calibration: Calibration | None


@dataclass(frozen=True)
class Splat:
    """A file of Gaussians.

    Attributes:
        sh_degree: of the file; ``values.used_sh_degree`` is the highest with coefficients that are not 0.
        encoding: of a PLY: "binary little-endian", "binary big-endian" or "ascii".
        columns: the vertices' properties in the order of the file, with their types; empty for other formats.
        extra: properties without a meaning here, copied to outputs unchanged.
        comments: of the header, without ours.
        tau: the threshold of ``values.fainter_than_tau``: the dial's, or the default of adapting.
        origin: what adapting reads the positions relative to, world units; 0 unless they are far from 0.
        screen_filter: that it is drawn with, stated or implied by the file.
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

    @property
    def dial_columns(self) -> str:
        """The columns of the dial, of a file that has one."""
        return "sigma_d" if self.values.growth is None else "sigma_d and growth_d"


def anomalies_of(splat: Splat, questions: dict[str, tuple[float, float]]) -> list[Anomaly]:
    """The anomalies of a file; ``questions`` are the ranges of columns that look activated, by name."""
    v, found = splat.values, []

    def note(kind: str, count: int, says: str) -> None:
        if count:
            found.append(Anomaly(kind, count, says.format(count=count)))

    for name, (low, high) in questions.items():
        says = f"{name} from {low:.4g} to {high:.4g}: looks activated, and is read as activated here; adapting needs"
        found.append(Anomaly("activated", 0, f"{says} --activated {choice_of(questions)}"))
    for reason, gone in v.dropped.items():
        note("unusable", gone, f"{{count:,}} rows are not used: {reason}")
    note("infinite_opacity", v.infinite_opacity, "{count:,} have opacity = +inf, which is fully opaque")
    note("doubles", v.doubles, "{count:,} have the same position as another Gaussian")
    note("far", v.far, f"{{count:,}} are at least {FAR:g} times as far from the centre as 90 % of all")
    note("giant", v.giant, "{count:,} are larger than half the scene")
    if splat.sh_degree and not v.used_sh_degree:
        note("empty_harmonics", 1, "all higher harmonics are 0: no view-dependent colour")
    if any(splat.origin):
        found.append(Anomaly("far_from_0", 0, "coordinates are far from 0; they are read relative to a local origin"))
    wide = [name for name, kind in splat.columns if kind == "float64"]
    note("double_precision", len(wide), f"{{count}} properties are double: {_list(wide)}")
    if splat.screen_filter.compensate:
        found.append(Anomaly("antialiased", 0, f"trained with antialiasing: {splat.screen_filter.description}"))
    return found


def left_out_of(splat: Splat, notes: Sequence[str], changes: Sequence[str]) -> list[str]:
    """Parts that adapting leaves out or does not change, a line each, from the reader's notes and changes."""
    v, lines = splat.values, []
    if gone := v.total - v.count:
        lines.append(f"{gone:,} of {v.total:,} rows, which are not usable")
    lines += [note.removeprefix("not carried over to outputs: ") for note in notes if "carried over" in note]
    if any(name == FILTER for name, _ in splat.columns):
        lines.append("filter_3D, which is merged into scale and opacity")
    if splat.sh_degree > v.used_sh_degree:
        lines.append(f"harmonics above degree {v.used_sh_degree}, which are 0: skipped in training, kept in the output")
    if splat.extra:
        lines.append(f"{_list(splat.extra)}: not used, copied to outputs")
    return lines + [change for change in changes if "taken as activated" in change]


def _list(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
