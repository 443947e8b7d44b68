"""Install lines work before a release too: they name other packages, or a checkout. The pages are installed."""

import re
import sysconfig
import tomllib
from pathlib import Path

import pytest

from clod_adapter.cli import adapt
from clod_adapter.cli.shared import command
from fences import ROOT

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
