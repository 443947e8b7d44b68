"""The series of a chart from each kind of report."""

from __future__ import annotations

from typing import Any

from clod_adapter.report.series import series_of


def row(s: float, psnr: float | None = 20.0) -> dict[str, Any]:
    return {"virtual_scale": s, "psnr": psnr, "ssim": 0.9, "kept": 10, "kept_share": 0.5, "in_view": 9, "frame_ms": 3.0}


def test_series_of_an_adaptation() -> None:
    report = {"rows": [row(1), row(5)], "base_rows": [row(1, 21)], "detached_row": row(1, 19)}
    dial, base, plain = series_of(report)
    assert (dial.label, dial.dial, dial.rows) == ("dial, one file", True, report["rows"])
    assert (base.label, base.dial, base.rows) == ("base, unadapted", False, report["base_rows"])
    assert (plain.label, plain.rows) == ("plain viewer, no dial", [report["detached_row"]])


def test_series_of_an_evaluation_with_comparisons() -> None:
    report = {
        "rows": [row(1), row(3)],
        "base_row": row(1, 22),
        "ranked": [{"by": by, "row": row(1, psnr)} for psnr in (21, 17) for by in ("opacity", "removal error")],
        "against": [
            {"model": "x/a.ply", "label": "x_a", "theirs": row(1)},
            *({"model": "y/a.ply", "label": "y_a", "theirs": row(s)} for s in (1, 3)),
        ],
    }
    found = {one.label: (one.dial, [r["psnr"] for r in one.rows]) for one in series_of(report)}
    assert found == {
        "dial, one file": (True, [20, 20]), "base, unadapted": (False, [22]),
        "base pruned by opacity": (False, [21, 17]),
        "base pruned by removal error": (False, [21, 17]), "x_a": (False, [20]), "y_a": (True, [20, 20]),
    }  # fmt: skip


def test_series_of_a_plain_model_and_of_missing_measurements() -> None:
    (plain,) = series_of({"rows": [row(1), row(2)], "attenuation": None})
    (dial,) = series_of({"rows": [row(1), row(2)], "attenuation": {"tau": 0.02}})
    assert (plain.label, plain.dial, dial.label, dial.dial) == ("the file, no dial", False, "dial, one file", True)
    assert series_of({"rows": [], "base_rows": [], "detached_row": None}) == []
    (one,) = series_of({"rows": [row(1, None), row(2)]})
    assert [r["virtual_scale"] for r in one.rows] == [2]
