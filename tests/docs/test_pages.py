"""The pages agree with the code: the report's fields are explained, and tables match the results."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Mapping
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from clod_adapter.cli.main import main
from clod_adapter.config import AdaptConfig
from clod_adapter.training.target_count import target_curve
from fences import ROOT

DOCS, RESULTS = ROOT / "docs", ROOT / "benchmarks" / "results"


def keys(value: Any) -> Iterator[str]:
    """The keys of all objects in a value, except in ``config``, which the Python page lists."""
    if isinstance(value, dict):
        for name, entry in value.items():
            yield name
            yield from keys(entry) if name != "config" else ()
    elif isinstance(value, list):
        for entry in value:
            yield from keys(entry)


def test_every_field_of_the_reports_is_explained(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    explained = set(re.findall(r"`([a-z_0-9]+)`", (DOCS / "report.md").read_text(encoding="utf-8")))
    model, base, scene = (str(desk / name) for name in ("pretrained_clod.ply", "pretrained.ply", "scene"))
    words = ["eval", model, "--images", scene, "--sv", "1", "3", "--popping", "--quiet"]
    words += ["--base", base, "--against", base]
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    measured = json.loads(capsys.readouterr().out)
    adapted = json.loads(desk.joinpath("pretrained_clod.json").read_text(encoding="utf-8"))
    assert {"rows", "alignment", "frame_ms"} <= set(keys(adapted)) and {"ranked", "moved"} <= set(keys(measured))
    missing = (set(keys(adapted)) | set(keys(measured))) - explained
    assert not missing, f"docs/report.md does not explain {sorted(missing)}"


def tables(page: Path) -> list[list[list[str]]]:
    """The tables of a page, as rows of cells without emphasis."""
    found = re.findall(r"(?:^\|.*\|\n)+", page.read_text(encoding="utf-8"), re.MULTILINE)
    lines = [[line for line in table.splitlines() if "---" not in line] for table in found]
    return [[[cell.strip(" *") for cell in line.strip("|").split("|")] for line in table] for table in lines]


def test_tables_of_ranges_match_the_results() -> None:
    with (RESULTS / "robustness.csv").open(encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["max_sv"] != "base"]
    places = ((row["checkpoint"], float(row["max_sv"]), f"s = {float(row['virtual_scale']):g}") for row in rows)
    cells = dict(zip(places, map(cell, rows), strict=True))
    ranges = (1, 3, 5, 7)
    page = [table for table in tables(DOCS / "max_sv.md") if table[0] == ["dial", *(f"max_sv {m}" for m in ranges)]]
    for table, checkpoint in zip(page, ("pretrained", "pretrained_mask"), strict=True):
        for name, *written in table[1:]:
            assert written == [cells[checkpoint, max_sv, name] for max_sv in ranges], f"{checkpoint}, {name}"


def cell(row: Mapping[str, Any]) -> str:
    return f"{float(row['psnr']):.2f} @ {100 * float(row['kept_share']):.0f} %"


def test_table_of_long_dials_matches_the_results() -> None:
    rows = [json.loads(line) for line in (RESULTS / "adapt.jsonl").read_text(encoding="utf-8").splitlines()]
    (page,) = [table for table in tables(DOCS / "max_sv.md") if table[0][1:2] == ["plush_half, 5"]]
    titles = page[0][1:]
    columns = []
    for scene, max_sv in (title.split(", ") for title in titles):
        own = "defaults" if float(max_sv) == AdaptConfig().max_sv else f"max_sv {max_sv}"
        run = [
            row for row in rows
            if (row["scene"], row["label"]) == (scene, f"near growth, {own}")
            and row["config"]["iters"] == 1600 and row["config"]["seed"] == 0
        ][-1]  # fmt: skip
        columns.append({f"s = {row['virtual_scale']:g}": cell(row) for row in run["rows"]})
    for name, *written in page[1:]:
        assert written == [column.get(name, "") for column in columns], name


def test_table_of_frames_matches_the_results() -> None:
    rows = [json.loads(line) for line in (RESULTS / "cost.jsonl").read_text(encoding="utf-8").splitlines()]
    last = {row["scene"]: row for row in rows if row["kind"] == "targets"}
    page = (DOCS / "performance.md").read_text(encoding="utf-8")
    for s in (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0):
        cells = [f"{s:g}"]
        for row in (last["plush_half"], last["bonsai146"]):
            at = next(found for found in row["count"] if found["virtual_scale"] == s)
            share = at["frame_ms"] / row["base"]["frame_ms"]
            cells.append(f"{at['psnr']:.2f} dB, {at['kept']:.0%}, {share:.0%}")
        assert f"| {' | '.join(cells)} |" in page


def test_target_counts_match_training() -> None:
    config = AdaptConfig()
    (dials, shares) = next(rows for rows in tables(DOCS / "equation.md") if rows[0][0] == "s")
    for s, share in zip(dials[1:], shares[1:], strict=True):
        assert share == f"{target_curve(float(s), config.share, config.exponent):.0%}".replace("%", " %")


def test_keys_match_the_viewer() -> None:
    source = ROOT / "clod_adapter" / "viewer" / "web" / "src" / "page.html"
    help = re.findall(r"<dt>(.+?)</dt><dd>(.+?)</dd>", source.read_text(encoding="utf-8"))
    (page,) = [table for table in tables(DOCS / "viewing.md") if len(table[1]) == 2]
    assert [tuple(row) for row in page[1:]] == [(unescape(keys), unescape(text)) for keys, text in help]
