"""The site: its links exist, it fetches nothing from other hosts, and its reference covers the code."""

import json
import re
import runpy
import sys
from importlib import import_module
from pathlib import Path

import pytest
from click.testing import CliRunner

import clod_adapter
from clod_adapter.cli.main import COMMANDS
from fences import FENCE, PAGES, ROOT

DOCS = ROOT / "docs"
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)|(?:href|src)=\"([^\"]+)\"")
FETCHED = re.compile(r"<(?!a\s|link\s[^>]*rel=\"?canonical)[^>]*\s(?:src|href)=\"?([^\s\">]+)")


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as Markdown's toc extension and GitHub make them."""
    found = set()
    for title in re.findall(r"^#+ +(.+?) *$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE):
        plain = re.sub(r"[^\w\s-]", "", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title)).strip().lower()
        found.add(re.sub(r"[-\s]+", "-", plain))
    return found


def test_links_and_pictures_exist() -> None:
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    for page, text in texts.items():
        for target in (one or other for one, other in LINK.findall(FENCE.sub("", text))):
            if target.startswith(("https://", "http://")):
                continue
            file, _, anchor = target.partition("#")
            found = (page.parent / file).resolve() if file else page
            assert found.exists(), f"{page.name}: {target}: no such file"
            assert not anchor or anchor in anchors(found), f"{page.name}: {target}: no such heading"
    for picture in (DOCS / "images").iterdir():
        assert picture.suffix == ".svg" or any(picture.name in text for text in texts.values()), picture.name


def test_the_built_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Built as by ``make docs``; a broken link is an error. Its search covers all pages and public names."""
    pytest.importorskip("mkdocs", reason="pip install '.[docs]'")
    site = tmp_path / "site"
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    monkeypatch.setattr(sys, "argv", ["make.py"])
    runpy.run_path("docs/make.py", run_name="__main__")
    done = CliRunner().invoke(import_module("mkdocs.__main__").cli, ["build", "--site-dir", str(site)])
    warned = [line for line in done.output.splitlines() if line.startswith("WARNING") and "griffe: " not in line]
    assert done.exit_code == 0 and not warned, done.output
    for page in site.glob("*.html"):
        fetched = FETCHED.findall(page.read_text(encoding="utf-8"))
        far = [url for url in fetched if re.match(r"([a-z]+:)?//", url)]
        assert fetched and not far, f"{page.name} fetches {far}"
    for style in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(https?:)?//|@import", style.read_text(encoding="utf-8")), style.name
    index = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))
    entries = {entry["location"] for entry in index["docs"]}
    pages = {f"{page.stem}.html" for page in DOCS.glob("*.md")} | {"commands.html", "settings.html", "names.html"}
    assert pages == {entry.partition("#")[0] for entry in entries}
    named = {f"names.html#{clod_adapter._homes[name]}.{name}" for name in clod_adapter.__all__}
    assert named | {f"commands.html#clod-adapt-{name}" for name in COMMANDS} <= entries
    assert (site / "search" / "search_index.js").is_file()  # for pages opened from a folder
    assert not list(site.rglob("*.py")) and not list(site.rglob("*.md"))
