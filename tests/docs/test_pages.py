"""The pages agree with the code and the results: the report's fields are explained, and tables match the rows."""

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
METHODS = {
    "specialist, a file each": "merged --decimate-adaptive, then tuned",
    "prefixes, one file": "prefixes by removal error, lengths log",
    "merging, uniform": "splat-transform 3.7.0 --decimate",
    "merging, adaptive": "splat-transform 3.7.0 --decimate-adaptive", "pruned": "untouched, by removal error",
}  # fmt: skip


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


def tables(page: str) -> list[list[list[str]]]:
    """The tables of a page, as rows of cells without emphasis."""
    found = re.findall(r"(?:^\|.*\|\n)+", (DOCS / page).read_text(encoding="utf-8"), re.MULTILINE)
    lines = [[line for line in table.splitlines() if "---" not in line] for table in found]
    return [[[cell.strip(" *") for cell in line.strip("|").split("|")] for line in table] for table in lines]


def rows_of(file: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (RESULTS / file).read_text(encoding="utf-8").splitlines()]


def cell(row: Any) -> str:
    return f"{float(row['psnr']):.2f} @ {percent(float(row['kept_share']))}"


def percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def test_tables_of_ranges_and_dials() -> None:
    with (RESULTS / "robustness.csv").open(encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["checkpoint"] == "pretrained" and row["max_sv"] != "base"]
    cells = {(float(row["max_sv"]), f"s = {float(row['virtual_scale']):g}"): cell(row) for row in rows}
    (table,) = [table for table in tables("method.md") if table[0][1:2] == ["max_sv 1"]]
    for name, *written in table[1:]:
        assert written == [cells[max_sv, name] for max_sv in (1, 3, 5, 7)], name
    runs = {(row["scene"], row["label"]): row for row in rows_of("adapt.jsonl")}
    (table,) = [table for table in tables("method.md") if table[0][1:2] == ["plush_half, 5"]]
    for k, title in enumerate(table[0][1:], 1):
        scene, max_sv = title.split(", ")
        run = runs[scene, "defaults" if max_sv == "5" else f"max_sv {max_sv}"]
        found = {f"s = {row['virtual_scale']:g}": cell(row) for row in run["rows"]}
        assert [line[k] for line in table[1:]] == [found.get(line[0], "") for line in table[1:]], title


def test_tables_of_shares() -> None:
    """Of ours with and without growth, and of other methods."""
    runs = {(row["scene"], row["label"]): row for row in rows_of("adapt.jsonl")}
    points = [(row["scene"], row["label"], point) for row in rows_of("rivals.jsonl") for point in row["rows"]]
    found = {(scene, label, percent(point["share"])): f"{point['psnr']:.2f}" for scene, label, point in points}
    for table in (table for table in tables("method.md") if table[0][1] == "full or s = 1"):
        scene, shares = table[0][0].partition(" ")[0], table[0][2:]
        for name, _, *written in (line for line in table[1:] if line[0] in METHODS):
            assert written == [found.get((scene, METHODS[name], share), "") for share in shares], name
        for line, label in zip(table[1:3], ("max_sv 20", "max_sv 20, growth off"), strict=True):
            if scene in ("plush_half", "bonsai146"):
                at = {percent(row["share"]): f"{row['psnr']:.2f}" for row in runs[scene, label]["at_shares"]}
                assert line[1:] == [cell(runs[scene, label]["rows"][0]), *(at.get(share, "") for share in shares)]


def test_tables_of_stability() -> None:
    rows = rows_of("stability.jsonl")
    bounds = {(row["quantity"], row["dtype"]): row for row in rows if row["part"] == "equation"}
    (table,) = [table for table in tables("performance.md") if table[0][1:2] == ["bound"]]
    for name, _, *written in table[1:]:
        quantity = name.replace("its inverse", "inverse of the extinction scale")
        found = [bounds[quantity, dtype] for dtype in ("float64", "float32")]
        assert written == [f"{row['worst']:.2g} ({row['worst_of_bound']:.0%})" for row in found], name
    assert not sum(row["failed"] + row["nan"] for row in bounds.values())
    scenes = {row["case"]: row for row in rows if row["part"] == "scenes" and "error" not in row}
    (table,) = [table for table in tables("performance.md") if table[0][-1] == "passes"]
    for name, *written in table[1:]:
        longer = name == "the same, 1,500 steps"
        row = scenes["max_sv 100, tau 0.004, 1,500 steps" if longer else re.split("[;,] at|;", name)[0]]
        ends = [f"{r['psnr']:.2f} @ {r['kept_share']:.0%}" for r in (row["rows"][0], row["rows"][-1])]
        assert written == [f"{row['base_psnr']:.2f}", *ends, "yes" if row["holds"] else "no"], name
