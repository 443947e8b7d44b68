"""Exponents of time and bytes per Gaussian from the rows of growth.py, and their tables for docs/growth.md."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter

from common import Row, stored

import numpy as np

FILE = "growth.jsonl"
COMMANDS = ("adapt", "eval", "export", "inspect", "view")
FLOOR, SIZES = 1000, (10_000, 100_000, 1_000_000, 5_000_000)
FROM = 100_000  # Gaussians from which exponents are fitted: below, start-up dominates
SERIES_COUNT = 100_000  # Gaussians of the series over photographs
FEW = 16  # photographs of the series over their size
BUSY = 3.0  # load of the machine above which other work disturbed the times


def latest() -> list[Row]:
    """The last row of each kind."""
    keys = ("series", "command", "gaussians", "images", "width", "height")
    found = {tuple(row[key] for key in keys): row for row in stored(FILE)}
    return [found[key] for key in sorted(found)]


def exponent(points: Sequence[tuple[float, float]]) -> float:
    """Of the power of x that y follows, by least squares in logarithms; NaN of fewer than two points."""
    usable = [point for point in points if point[1] > 0]
    return float(np.polyfit(*np.log(usable).T, 1)[0]) if len(usable) > 1 else math.nan


def over_count(rows: Sequence[Row], command: str) -> list[Row]:
    return [row for row in rows if row["series"] == "count" and row["command"] == command]


def seconds_of(rows: Sequence[Row], command: str, phase: str = "") -> list[tuple[float, float]]:
    """(Gaussians, seconds) of a command, or of a phase of adapting."""
    return [(row["gaussians"], phase_of(row, phase)) for row in over_count(rows, command)]


def phase_of(row: Row, phase: str) -> float:
    if not phase:
        return row["seconds"]
    if phase == "importance":
        return row["phases"]["start"] - row["order_seconds"]
    return row["order_seconds"] if phase == "order" else row["phases"][phase]


PHASES = ("load", "importance", "order", "step", "evaluate", "write")


def cpu_of(rows: Sequence[Row], command: str, phase: str = "") -> list[tuple[float, float]]:
    """(Gaussians, CPU seconds) of a command, or of a phase of adapting: less affected by other work on the machine."""
    return [
        (row["gaussians"], phase_cpu(row, phase))
        for row in over_count(rows, command)
        if "phase_cpu" in row or not phase
    ]


def phase_cpu(row: Row, phase: str) -> float:
    if not phase or phase == "order":
        return row["order_cpu"] if phase else row["cpu_seconds"]
    of = row["phase_cpu"]
    return {
        "load": of["load"], "importance": of["start"] - row["order_cpu"], "step": of["train"] / row["steps"],
        "evaluate": of["base"] + of["measure and write again"] - of["write"], "write": of["write"],
    }[phase]  # fmt: skip


def growth(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
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
    """Markdown for docs/growth.md."""
    sizes = sorted({row["gaussians"] for row in rows if row["series"] == "count"})
    head = "| | " + " | ".join(f"{size:,}" for size in sizes) + " | exponent | last two | exponent of CPU |"
    busy = max(row["busy"] for row in rows)
    lines = [f"**Preliminary**: the machine's load was up to {busy:.0f} while these rows were taken, so wall times are "
             "several times too long; CPU times and memory are not affected.", ""] if busy > BUSY else []  # fmt: skip
    lines += [head, "|---" * (len(sizes) + 4) + "|"]
    cases = [(command, "") for command in COMMANDS] + [("adapt", phase) for phase in PHASES]
    for command, phase in cases:
        points = seconds_of(rows, command, phase)
        fitted, last = growth(points)
        cells = [f"{dict(points)[size]:.3g}" if size in dict(points) else "" for size in sizes]
        powers = " | ".join(f"{power:.2f}" for power in (fitted, last, growth(cpu_of(rows, command, phase))[0]))
        lines.append(f"| {phase or command} | {' | '.join(cells)} | {powers} |")
    lines += ["", "| | peak, GB | | bytes per Gaussian | fixed, MB |", "|---|---|---|---|---|"]
    for command in COMMANDS:
        each, rest = bytes_a_gaussian(rows, command)
        peaks = [f"{row['gaussians']:,}: {row['peak_bytes'] / 1e9:.2f}" for row in over_count(rows, command)[-2:]]
        lines.append(f"| {command} | {' | '.join(peaks or ['', ''])} | {each:,.0f} | {rest / 1e6:,.0f} |")
    for row in over_count(rows, "adapt")[-1:]:
        peaks = row["phase_peaks"]
        lines += ["", f"| adapt, {row['gaussians']:,}: up to | {' | '.join(peaks)} |", "|---" * (len(peaks) + 1) + "|"]
        per = " | ".join(f"{peak / row['gaussians']:,.0f}" for peak in peaks.values())
        lines.append(f"| resident bytes per Gaussian | {per} |")
    for series, name, x in (("images", "photographs", itemgetter("images")), ("shapes", "megapixels", megapixels)):
        chosen = sorted((row for row in rows if row["series"] == series), key=x)
        lines += ["", f"| adapt over {name} | seconds | start | step | evaluate | load | peak, GB |", "|---" * 7 + "|"]
        for row in chosen:
            times = " | ".join(f"{row['phases'][key]:.3g}" for key in ("start", "step", "evaluate", "load"))
            lines.append(f"| {x(row):.3g} | {row['seconds']:.3g} | {times} | {row['peak_bytes'] / 1e9:.2f} |")
        powers = [exponent([(x(row), row["phases"][key]) for row in chosen]) for key in ("start", "step", "evaluate")]
        lines.append(f"| exponent | | {' | '.join(f'{power:.2f}' for power in powers)} | | |")
    return "\n".join(lines)
