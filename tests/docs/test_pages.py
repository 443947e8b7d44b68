"""The pages agree with the code and the results: fields are explained, tables match the rows, and lines install.

Install lines work before a release too: they name other packages, or a checkout. The pages are installed.
"""

import csv
import json
import re
import sysconfig
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from clod_adapter.cli import adapt
from clod_adapter.cli.main import main
from clod_adapter.cli.shared import command
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


def tables(page: str) -> list[list[list[str]]]:
    """The tables of a page, as rows of cells without emphasis."""
    found = re.findall(r"(?:^\|.*\|\n)+", (DOCS / page).read_text(encoding="utf-8"), re.MULTILINE)
    lines = [[line for line in table.splitlines() if "---" not in line] for table in found]
    return [[[cell.strip(" *") for cell in line.strip("|").split("|")] for line in table] for table in lines]


def measured(value: Any) -> Iterator[str]:
    """The qualities in results, at any depth, in the forms that the pages write."""
    if isinstance(value, list):
        for entry in value:
            yield from measured(entry)
    elif isinstance(value, dict):
        share = value.get("kept_share", value.get("share"))
        for name in ("psnr", "base_psnr"):
            if value.get(name):
                yield (psnr := f"{float(value[name]):.2f}")
                yield f"{psnr} @ {float(share or 1):.0%}"
        for entry in value.values():
            yield from measured(entry)


def test_qualities_in_tables_are_measured() -> None:
    """A number of decibels, with or without the share kept, is one of benchmarks/results."""
    found = set()
    for file in RESULTS.glob("*.jsonl"):
        found |= {each for line in file.read_text(encoding="utf-8").splitlines() for each in measured(json.loads(line))}
    with (RESULTS / "robustness.csv").open(encoding="utf-8") as stream:
        found |= set(measured(list(csv.DictReader(stream))))
    cells = [
        cell for page in ("method.md", "performance.md") for table in tables(page) for row in table for cell in row
    ]
    told = [cell.replace(" %", "%") for cell in cells if re.fullmatch(r"\d\d\.\d\d( @ \d+ ?%)?", cell)]
    assert len(told) > 50 and not {*told} - found


SOURCES = [ROOT / "README.md", *(path for folder in ("cli", "clod_adapter") for path in (ROOT / folder).rglob("*.py"))]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_no_line_installs_clod_adapter_from_the_index() -> None:
    for path in (*SOURCES, *(ROOT / "docs").glob("*.md")):
        assert not re.search(r"pip install[^`\n]*clod-adapter", path.read_text(encoding="utf-8")), path


def test_help_names_the_installed_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ((folder, patterns),) = PROJECT["tool"]["setuptools"]["data-files"].items()
    assert patterns == ["docs/*.md"] and all(url.startswith("https://") for url in PROJECT["project"]["urls"].values())
    assert command.manual() == ROOT / "docs" / "index.md"  # of the checkout
    monkeypatch.setattr(command, "__file__", str(tmp_path / "lib" / "cli" / "shared" / "command.py"))
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(tmp_path))
    monkeypatch.setattr(command, "getuserbase", lambda: str(tmp_path))
    assert "manual:" not in command.parser_of(adapt, "clod-adapt").format_help()
    page = tmp_path / folder / "index.md"
    page.parent.mkdir(parents=True)
    page.touch()
    assert command.parser_of(adapt, "clod-adapt").format_help().endswith(f"\nmanual: {page}\n")
