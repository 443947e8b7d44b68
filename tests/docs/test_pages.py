"""The pages agree with the code and the results: the report's fields are explained, and tables match the rows."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from clod_adapter.cli.main import main
from fences import ROOT

DOCS, RESULTS = ROOT / "docs", ROOT / "benchmarks" / "results"


def keys(value: Any) -> Iterator[str]:
    """The keys of all objects in a value, except in ``config``, which the settings page lists."""
    if isinstance(value, dict):
        for name, entry in value.items():
            yield name
            yield from keys(entry) if name != "config" else ()
    elif isinstance(value, list):
        for entry in value:
            yield from keys(entry)


def test_every_field_of_the_reports_is_explained(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    explained = set(re.findall(r"`([a-z_0-9]+)`", (DOCS / "python.md").read_text(encoding="utf-8")))
    model, base, scene = (str(desk / name) for name in ("pretrained_clod.ply", "pretrained.ply", "scene"))
    words = ["eval", model, "--images", scene, "--sv", "1", "3", "--popping", "--quiet"]
    capsys.readouterr()
    assert main([*words, "--base", base, "--against", base, "--json"]) == 0
    measured = json.loads(capsys.readouterr().out)
    adapted = json.loads(desk.joinpath("pretrained_clod.json").read_text(encoding="utf-8"))
    assert {"rows", "alignment", "frame_ms"} <= set(keys(adapted)) and {"ranked", "moved"} <= set(keys(measured))
    missing = (set(keys(adapted)) | set(keys(measured))) - explained
    assert not missing, f"docs/python.md does not explain {sorted(missing)}"


def tables(page: Path) -> list[list[list[str]]]:
    """The tables of a page, as rows of cells without emphasis."""
    found = re.findall(r"(?:^\|.*\|\n)+", page.read_text(encoding="utf-8"), re.MULTILINE)
    lines = [[line for line in table.splitlines() if "---" not in line] for table in found]
    return [[[cell.strip(" *") for cell in line.strip("|").split("|")] for line in table] for table in lines]


def rows_of(file: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (RESULTS / file).read_text(encoding="utf-8").splitlines()]


def cell(row: Any) -> str:
    return f"{float(row['psnr']):.2f} @ {100 * float(row['kept_share']):.0f} %"


def test_table_of_ranges_matches_the_results() -> None:
    with (RESULTS / "robustness.csv").open(encoding="utf-8") as stream:
        rows = [
            row for row in csv.DictReader(stream) if (row["checkpoint"], row["max_sv"] == "base") == ("pretrained", 0)
        ]
    cells = {(float(row["max_sv"]), f"s = {float(row['virtual_scale']):g}"): cell(row) for row in rows}
    (page,) = [table for table in tables(DOCS / "method.md") if table[0][1:2] == ["max_sv 1"]]
    for name, *written in page[1:]:
        assert written == [cells[max_sv, name] for max_sv in (1, 3, 5, 7)], name


def test_tables_of_dials_match_the_results() -> None:
    runs = {(row["scene"], row["label"]): row for row in rows_of("adapt.jsonl")}
    (page,) = [table for table in tables(DOCS / "method.md") if table[0][1:2] == ["plush_half, 5"]]
    for k, title in enumerate(page[0][1:], 1):
        scene, max_sv = title.split(", ")
        run = runs[scene, "defaults" if max_sv == "5" else f"max_sv {max_sv}"]
        cells = {f"s = {row['virtual_scale']:g}": cell(row) for row in run["rows"]}
        assert [line[k] for line in page[1:]] == [cells.get(line[0], "") for line in page[1:]], title
    for table in tables(DOCS / "method.md"):
        if (scene := table[0][0].partition(" ")[0]) in ("plush_half", "bonsai146") and table[0][1] == "full or s = 1":
            for line, label in zip(table[1:3], ("max_sv 20", "max_sv 20, growth off"), strict=True):
                at = {f"{100 * row['share']:.0f} %": f"{row['psnr']:.2f}" for row in runs[scene, label]["at_shares"]}
                assert line[1:] == [cell(runs[scene, label]["rows"][0]), *(at.get(share, "") for share in table[0][2:])]


def test_table_of_rivals_matches_the_results() -> None:
    found: dict[tuple[str, str, str], str] = {}
    for row in rows_of("rivals.jsonl"):
        for point in row["rows"]:
            found[row["scene"], row["label"], f"{100 * point['share']:.0f} %"] = f"{point['psnr']:.2f}"
    labels = {
        "specialist, a file each": "merged --decimate-adaptive, then tuned",
        "prefixes, one file": "prefixes by removal error, lengths log",
        "merging, uniform": "splat-transform 3.7.0 --decimate",
        "merging, adaptive": "splat-transform 3.7.0 --decimate-adaptive", "pruned": "untouched, by removal error",
    }  # fmt: skip
    for table in tables(DOCS / "method.md"):
        if table[0][1] == "full or s = 1":
            for name, _, *written in table[1:]:
                if name in labels:
                    at = [(table[0][0].partition(" ")[0], labels[name], share) for share in table[0][2:]]
                    assert written == [found.get(key, "") for key in at], name


def test_tables_of_the_equation_match_the_results() -> None:
    rows = {(row["quantity"], row["dtype"]): row for row in rows_of("stability.jsonl") if row["part"] == "equation"}
    (page,) = [table for table in tables(DOCS / "performance.md") if table[0][1:2] == ["bound"]]
    for name, _, *written in page[1:]:
        quantity = name.replace("its inverse", "inverse of the extinction scale")
        found = [rows[quantity, dtype] for dtype in ("float64", "float32")]
        assert written == [f"{row['worst']:.2g} ({row['worst_of_bound']:.0%})" for row in found], name
    assert not sum(row["failed"] + row["nan"] for row in rows.values())


def test_table_of_extreme_scenes_matches_the_results() -> None:
    rows = {row["case"]: row for row in rows_of("stability.jsonl") if row["part"] == "scenes" and "error" not in row}
    (page,) = [table for table in tables(DOCS / "performance.md") if table[0][-1] == "passes"]
    for name, *written in page[1:]:
        row = rows.get(
            {"the same, 1,500 steps": "max_sv 100, tau 0.004, 1,500 steps"}.get(name, re.split("[;,] at|;", name)[0])
        )
        assert row, name
        ends = [f"{r['psnr']:.2f} @ {r['kept_share']:.0%}" for r in (row["rows"][0], row["rows"][-1])]
        assert written == [f"{row['base_psnr']:.2f}", *ends, "yes" if row["holds"] else "no"], name
