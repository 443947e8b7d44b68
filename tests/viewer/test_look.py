"""The viewer's page and the report have one look."""

from __future__ import annotations

import re
from pathlib import Path

import clod_adapter

PACKAGE = Path(clod_adapter.__file__).parent


def colours(path: Path) -> list[dict[str, str]]:
    """What the style defines in light and in dark, by name; minified or not."""
    style = (
        re.sub(r"\s", "", path.read_text(encoding="utf-8")).replace("#fff;", "#ffffff;").replace("#fff}", "#ffffff}")
    )
    blocks = re.findall(r":root\{(.*?)\}", style)
    assert len(blocks) == 2
    return [dict(re.findall(r"--([\w-]+):(#\w+)", block)) for block in blocks]


def test_colours_are_those_of_the_report() -> None:
    for ours, theirs in zip(
        colours(PACKAGE / "viewer" / "static" / "viewer.css"), colours(PACKAGE / "report" / "style.css"), strict=True
    ):
        assert {"paper", "card", "ink", "quiet", "line", "accent"} == set(ours)
        assert ours.items() <= theirs.items()
