"""Series of a chart, from the rows that ``clod-adapt --json`` and ``clod-adapt eval --json`` print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Series:
    """Rows of one file or baseline.

    Attributes:
        rows: each with psnr, ssim, kept, frame_ms, and for a dial virtual_scale.
        dial: whether the rows are one file at several dial values.
    """

    label: str
    rows: Sequence[Row]
    dial: bool = False


def series_of(report: Mapping[str, Any]) -> list[Series]:
    """The series of a report: the model at its dial values first, then the measured comparisons.

    Keys: ``rows``; ``base_row`` or ``base_rows``, the unadapted base; ``detached_row``, the file without its dial;
    ``ranked``, ``[{by, row}]``, the base pruned by rank; ``against``, ``[{model, label, theirs}]``, other files. Rows
    without a PSNR (null in JSON if infinite) are skipped.
    """
    base: list[Any] = report.get("base_rows") or [report.get("base_row")]
    plain_model = report.get("attenuation", {}) is None  # evaluation of a file without a dial
    model = Series("the file, no dial" if plain_model else "dial, one file", report.get("rows", []), not plain_model)
    found = [model, Series("base, unadapted", base)]
    ranked = report.get("ranked") or []
    for by in dict.fromkeys(entry["by"] for entry in ranked):
        found.append(Series(f"base pruned by {by}", [entry["row"] for entry in ranked if entry["by"] == by]))
    against = report.get("against") or []
    for path in dict.fromkeys(entry["model"] for entry in against):
        rows = [entry["theirs"] for entry in against if entry["model"] == path]
        label = next(entry["label"] for entry in against if entry["model"] == path)
        found.append(Series(label, rows, dial=len(rows) > 1))
    plain: list[Any] = [report.get("detached_row")]
    found.append(Series("plain viewer, no dial", plain))
    complete = [Series(s.label, [r for r in s.rows if r and r["psnr"] is not None], s.dial) for s in found]
    return [series for series in complete if series.rows]
