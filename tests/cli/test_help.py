"""``--help`` of every command, and the options that all have."""

from __future__ import annotations

import re
from typing import Any

import pytest

from clod_adapter._support.version import package_version
from clod_adapter.cli.main import COMMANDS


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(clod: Any, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options are grouped: inputs come first and general options last; none is outside a group."""
    monkeypatch.setenv("COLUMNS", "80")
    done = clod(*command.split(), "--help")
    assert done.code == 0 and done.out.startswith("usage: clod-adapt") and "--json" in done.out
    *lines, page = done.out.splitlines()
    assert max(map(len, lines)) <= 80 and page.startswith("manual: ") and page.endswith("index.md")
    short = re.search(r"\n  -o[ ,]", done.out) is not None  # Python 3.13 writes "-o, --out X", 3.12 "-o X, --out X"
    assert ("--out " in done.out) == short == (command not in ("eval", "inspect", "view", "doctor"))
    titles = re.findall(r"(?m)^(\w[\w ,]*):\n  (?:-|[A-Z])", done.out)
    titles = titles[: titles.index("general") + 1]
    assert titles[0] == {"demo": "output", "doctor": "general"}.get(command, "input")
    assert not {"positional arguments", "options"} & set(titles)
    if not command:
        assert all(f"clod-adapt {other}" in done.out for other in COMMANDS)
        assert clod("--version").out.split() == ["clod-adapt", package_version()]
