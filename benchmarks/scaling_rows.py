"""Exponents of time and bytes per Gaussian from the rows of scaling.py, and their tables for docs/scaling.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import itemgetter

from common import Row, stored, table

import numpy as np

FILE = "scaling.jsonl"
COMMANDS = ("adapt", "eval", "export", "inspect", "view")
FLOOR, SIZES = 1000, (10_000, 100_000, 1_000_000, 5_000_000)
FROM = 100_000  # Gaussians from which exponents are fitted: below, start-up dominates
SERIES_COUNT = 100_000  # Gaussians of the series over photographs
FEW = 16  # photographs of the series over their size
Points = Sequence[tuple[float, float]]


def latest() -> list[Row]:
    """The last row of each kind."""
    keys = ("series", "command", "gaussians", "images", "width", "height")
    found = {tuple(row[key] for key in keys): row for row in stored(FILE)}
    return [found[key] for key in sorted(found)]


def exponent(points: Points) -> float:
    """Of the power of x that y follows, by least squares in logarithms; NaN of fewer than two points."""
    usable = [point for point in points if point[1] > 0]
    return float(np.polyfit(*np.log(usable).T, 1)[0]) if len(usable) > 1 else math.nan


def over_count(rows: Sequence[Row], command: str) -> list[Row]:
    return [row for row in rows if row["series"] == "count" and row["command"] == command]


PHASES, PARTS = ("load", "importance", "order", "step", "evaluate", "write"), ("importance", "order")


def wall(row: Row, phase: str) -> float:
    """Seconds of a command, or of a phase of adapting."""
    if phase in PARTS:
        return row[f"{phase}_seconds"]
    return row["phases"][phase] if phase else row["seconds"]


def cpu(row: Row, phase: str) -> float:
    """The same in CPU seconds: less affected by other work on the machine."""
    if not phase or phase in PARTS:
        return row[f"{phase}_cpu"] if phase else row["cpu_seconds"]
    of = row["phase_cpu"]
    return {
        "load": of["load"], "step": of["train"] / row["steps"],
        "evaluate": of["base"] + of["measure and write again"] - of["write"], "write": of["write"],
    }[phase]  # fmt: skip


def times_of(rows: Sequence[Row], command: str, phase: str = "", clock: Callable[[Row, str], float] = wall) -> Points:
    """(Gaussians, seconds) of a command, or of a phase of adapting."""
    return [(row["gaussians"], clock(row, phase)) for row in over_count(rows, command)]


def growth(points: Points) -> tuple[float, float]:
    """The exponent above the floor from FROM on, and that of the last two sizes with the floor in it."""
    floor = dict(points).get(FLOOR, 0.0)
    fitted = exponent([(x, y - floor) for x, y in points if x >= FROM])
    return fitted, exponent(points[-2:])


def bytes_a_gaussian(rows: Sequence[Row], command: str) -> tuple[float, float]:
    """What each Gaussian adds to the peak, and the peak without any: a line through the largest two sizes."""
    points = [(row["gaussians"], row["peak_bytes"]) for row in over_count(rows, command)][-2:]
    if len(points) < 2:
        return math.nan, math.nan
    (n, low), (m, high) = points
    each = (high - low) / (m - n)
    return each, low - each * n


def megapixels(row: Row) -> float:
    return row["width"] * row["height"] / 1e6


def tables(rows: Sequence[Row]) -> str:
    """Markdown for docs/scaling.md."""
    return "\n\n".join([times_table(rows), *memory_tables(rows), *(series_table(rows, *each) for each in X)])


def times_table(rows: Sequence[Row]) -> str:
    sizes, lines = sorted({row["gaussians"] for row in rows if row["series"] == "count"}), []
    for command, phase in [(command, "") for command in COMMANDS] + [("adapt", phase) for phase in PHASES]:
        points = times_of(rows, command, phase)
        cells = [f"{dict(points)[size]:.3g}" if size in dict(points) else "" for size in sizes]
        powers = [*growth(points), growth(times_of(rows, command, phase, cpu))[0]]
        lines.append([phase or command, *cells, *(f"{power:.2f}" for power in powers)])
    return table(["", *(f"{size:,}" for size in sizes), "exponent", "last two", "exponent of CPU"], lines)


def memory_tables(rows: Sequence[Row]) -> list[str]:
    """Peaks of the commands, and of the phases of adapting the largest city."""
    lines = []
    for command in COMMANDS:
        each, rest = bytes_a_gaussian(rows, command)
        peaks = [f"{row['gaussians']:,}: {row['peak_bytes'] / 1e9:.2f}" for row in over_count(rows, command)[-2:]]
        lines.append([command, *(peaks or ["", ""]), f"{each:,.0f}", f"{rest / 1e6:,.0f}"])
    found = [table(["", "peak, GB", "", "bytes per Gaussian", "fixed, MB"], lines)]
    for row in over_count(rows, "adapt")[-1:]:
        each = [f"{peak / row['gaussians']:,.0f}" for peak in row["phase_peaks"].values()]
        heads = [f"adapt, {row['gaussians']:,}: up to", *row["phase_peaks"]]
        found.append(table(heads, [["resident bytes per Gaussian", *each]]))
    return found


X = (("images", "photographs", itemgetter("images")), ("shapes", "megapixels", megapixels))


def series_table(rows: Sequence[Row], series: str, name: str, x: Callable[[Row], float]) -> str:
    chosen, lines = sorted((row for row in rows if row["series"] == series), key=x), []
    for row in chosen:
        times = [f"{row['phases'][key]:.3g}" for key in ("start", "step", "evaluate", "load")]
        lines.append([f"{x(row):.3g}", f"{row['seconds']:.3g}", *times, f"{row['peak_bytes'] / 1e9:.2f}"])
    powers = [exponent([(x(row), row["phases"][key]) for row in chosen]) for key in ("start", "step", "evaluate")]
    lines.append(["exponent", "", *(f"{power:.2f}" for power in powers), "", ""])
    return table([f"adapt over {name}", "seconds", "start", "step", "evaluate", "load", "peak, GB"], lines)
