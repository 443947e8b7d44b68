"""The site: its links exist, it fetches nothing from other hosts, and its pages agree with the code."""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

import clod_adapter
from fences import FENCE, PAGES, ROOT

DOCS = ROOT / "docs"
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)|(?:href|src)=\"([^\"]+)\"")


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as Markdown's toc extension and GitHub make them."""
    found = set()
    for title in re.findall(r"^#+ +(.+?) *$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE):
        plain = re.sub(r"[^\w\s-]", "", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title)).strip().lower()
        found.add(re.sub(r"[-\s]+", "-", plain))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_anchors_exist(page: Path) -> None:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for target in (one or other for one, other in LINK.findall(text)):
        if target.startswith(("https://", "http://")):
            continue
        file, _, anchor = target.partition("#")
        found = (page.parent / file).resolve() if file else page
        assert found.exists(), f"{page.name}: {target}: no such file"
        assert not anchor or anchor in anchors(found), f"{page.name}: {target}: no such heading"


@pytest.mark.parametrize("name", ["commands.md", "settings.md"])
def test_the_reference_is_current(name: str) -> None:
    made = runpy.run_path(str(DOCS / "make.py"))["PAGES"][name]()
    assert (DOCS / name).read_text(encoding="utf-8") == made, "run python docs/make.py"


def test_the_picture_of_the_equation_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    made = runpy.run_path(str(DOCS / "make.py"))
    made["equation_picture"](tmp_path / "equation.png")
    assert (tmp_path / "equation.png").stat().st_size > 10_000 and made["PICTURE"].is_file()


def test_the_python_page_lists_every_public_name() -> None:
    listed = re.findall(r"^::: (\S+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    named = {f"clod_adapter.{clod_adapter._homes[name]}.{name}" for name in clod_adapter.__all__}
    # What needs another package, or few people need, its user imports from where it is.
    modules = ("integrations", "blocks")
    apart = {name for name in listed if name.split(".")[1] in modules or ".distributed." in name}
    assert len(listed) == len(set(listed)) and set(listed) == named | apart and len(apart - named) == 11


def test_colours_match_the_reports() -> None:
    ours, theirs = DOCS / "style.css", ROOT / "clod_adapter" / "report" / "style.css"
    pairs = [re.findall(r"(--[a-z0-9-]+): ([^;]+);", path.read_text(encoding="utf-8")) for path in (ours, theirs)]
    names = {name for name, _ in pairs[1]}
    assert [(name, value) for name, value in pairs[0] if name in names] == pairs[1]


class Fetched(HTMLParser):
    """The URLs that a browser fetches to show a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.urls: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        fetches = "src" if tag != "link" else "href" if named.get("rel") != "canonical" else ""
        self.urls += [named[fetches] or ""] if fetches in named else []


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site built as by ``make docs``, where a broken link or an unlisted page is an error."""
    pytest.importorskip("mkdocs", reason="pip install '.[docs]'")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return out


ITEM = re.compile(r"^ *(\d+\.|[-*]) +\S")
WITHOUT_COUNT = {"api.md"}  # made from docstrings


def written(page: Path) -> tuple[int, int, list[str]]:
    """The ordered and the other list items of a page, and its code: fences and indented formulas, without blanks."""
    text = page.read_text(encoding="utf-8")
    code = [fence[3] for fence in FENCE.findall(text)]
    ordered = others = 0
    inside, block = False, list[str]()
    for line in [*FENCE.sub("", text).splitlines(), ""]:
        depth = 8 if inside else 4  # in a list item
        if line.strip() and not line.startswith(" " * depth):
            code += ["\n".join(block)] if block else []
            block = []
            item = ITEM.match(line)
            inside = bool(item) or (inside and line.startswith(" "))
            ordered += bool(item) and item[1][0].isdigit()
            others += bool(item) and not item[1][0].isdigit()
            starts = False
        elif line.strip() and (block or starts):
            block.append(line)
        elif not line.strip():
            starts = True  # a formula has a blank line above it
    code += ["\n".join(block)] if block else []
    return ordered, others, ["".join(each.split()) for each in code]


class Shown(HTMLParser):
    """The lists and code of a page's article: counts of list items by their list, and texts without blanks."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.lists, self.items, self.code, self.deep = list[str](), {"ol": 0, "ul": 0}, list[str](), 0
        self.inside = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.inside = self.inside or tag == "article"
        if not self.inside:
            return
        if tag in self.items:
            self.lists.append(tag)
        elif tag == "li":
            self.items[self.lists[-1]] += 1
        elif tag == "pre":
            self.code.append("")
            self.deep += 1

    def handle_endtag(self, tag: str) -> None:
        self.inside = self.inside and tag != "article"
        if self.inside and tag in self.items:
            self.lists.pop()
        self.deep -= self.inside and tag == "pre"

    def handle_data(self, data: str) -> None:
        if self.deep:
            self.code[-1] += "".join(data.split())


def test_every_list_item_and_formula_is_shown(site: Path) -> None:
    """Counted in the source, where indentation by three spaces ends a list for the site but not on GitHub."""
    sources = [page for page in sorted(DOCS.glob("*.md")) if page.name not in WITHOUT_COUNT]
    formulas = 0
    for page in sources:
        ordered, others, code = written(page)
        shown = Shown((site / f"{page.stem}.html").read_text(encoding="utf-8"))
        assert shown.items == {"ol": ordered, "ul": others}, page.name
        assert sorted(shown.code) == sorted(code), page.name
        formulas += len(code) - len(FENCE.findall(page.read_text(encoding="utf-8")))
    assert len(sources) > 20 and formulas >= 3, formulas


def test_the_built_site(site: Path) -> None:
    """The site loads nothing from other hosts, its search covers all pages, and it publishes pages only."""
    pages = sorted(site.glob("*.html"))
    assert len(pages) > len(list(DOCS.glob("*.md")))
    for page in pages:
        fetched = Fetched(page.read_text(encoding="utf-8")).urls
        assert fetched or page.name == "error_vs_time.html"
        far = [url for url in fetched if re.match(r"([a-z]+:)?//", url) and not url.startswith("data:")]
        assert not far, f"{page.name} fetches {far}"
    for style in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(https?:)?//|@import", style.read_text(encoding="utf-8")), style.name
    index = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))
    entries = {entry["location"] for entry in index["docs"]}
    assert {f"{page.stem}.html" for page in DOCS.glob("*.md")} == {entry.partition("#")[0] for entry in entries}
    assert {"api.html#clod_adapter.io.checkpoint.load", "api.html#clod_adapter.training.loop.adapt"} <= entries
    assert (site / "search" / "search_index.js").is_file()  # for pages opened from a folder
    assert not list(site.rglob("*.py")) and not list(site.rglob("*.md"))
