"""Every command in the documentation parses, and runs unless its block states a reason; the pages
agree with the code and the results, install lines work before a release too, and the site fetches
nothing from other hosts.
"""

import csv
import json
import re
import runpy
import shlex
import shutil
import sys
import sysconfig
import textwrap
import tomllib
from contextlib import redirect_stdout
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from click.testing import CliRunner
from common import ROOT

import clod_adapter
from clod_adapter.cli import adapt
from clod_adapter.cli.main import COMMANDS, build_parser, main
from clod_adapter.cli.shared import command
from clod_adapter.config import AdaptConfig
from formats import without_comments
from runs import accepted

PAGES = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^( *)(`{3,})(\w*)\n(.*?)^\1\2 *$", re.DOTALL | re.MULTILINE)


class Block(NamedTuple):
    """A fenced block; ``reason`` is that of ``<!-- not run: REASON -->`` above it, and empty if it
    is run.
    """

    place: str
    language: str  # of the fence; ``sh`` for the README's, which have none
    text: str
    reason: str

    def commands(self):
        """The words of each line of a shell block, without comments, continued lines put
        together.
        """
        if self.language not in ("sh", "console"):
            return []
        lines = self.text.replace("\\\n", " ").splitlines()
        commands = (shlex.split(line.removeprefix("$ "), comments=True) for line in lines)
        return [words for words in commands if words]


def blocks(page):
    text = page.read_text("utf-8")
    found = []
    for match in FENCE.finditer(text):
        marker = re.search(r"<!-- not run: ([^>]+?) -->\s*\Z", text[: match.start()])
        language = match[3] or ("sh" if page.name == "README.md" else "")
        place = f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}"
        found.append(Block(place, language, textwrap.dedent(match[4]), marker[1] if marker else ""))
    return found


def spoken(page, program):
    """Complete commands of a program with options, within sentences and in indented blocks."""
    text = FENCE.sub("", page.read_text("utf-8"))
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]
    lines = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    commands = [text.partition("  #")[0].strip() for text in [*spans, *lines]]
    complete = [text for text in commands if " -" in text and "..." not in text]
    return [text for text in complete if text.startswith(f"{program} ")]


@pytest.fixture(scope="session")
def desk(capture, attenuated, tmp_path_factory):
    """``scene/``, ``pretrained.ply``, ``pretrained_mask.ply`` (MaskGaussian's old layout),
    ``pretrained_clod.*``, and ``demo/`` with the demo's file names.
    """
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(capture.scene, folder / "scene")
    shutil.copyfile(capture.ply, folder / "pretrained.ply")
    masks = {"masks_0": np.where(np.arange(len(capture.gaussians)) % 10 == 0, -4, 4), "masks_1": 0}
    without_comments(folder / "pretrained.ply", **masks).rename(folder / "pretrained_mask.ply")
    for suffix in (".ply", ".safetensors", ".json"):
        shutil.copyfile(attenuated.with_suffix(suffix), folder / f"pretrained_clod{suffix}")
    shutil.copytree(capture.scene, folder / "demo" / "capture")
    shutil.copyfile(capture.ply, folder / "demo" / "base.ply")
    shutil.copyfile(attenuated, folder / "demo" / "gallery.ply")
    return folder


IDS = [str(page.relative_to(ROOT)) for page in PAGES]
LANGUAGES = {"sh", "console", "python", "text", "json", "glsl", "wgsl", "html", "css", "js"}
STEPS = 20  # of a training that the pages run, at most
# Commands that are not run: two change the environment that the tests run in, and one, the demo,
# takes a minute.
SKIPPED = ("pip", "make", "clod-adapt demo")


@pytest.mark.usefixtures("without_splat_transform")
@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_blocks_run_in_the_order_of_the_page(page, desk, tmp_path, monkeypatch):
    """Training is shortened."""
    shutil.copytree(desk, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(clod_adapter, "AdaptConfig", short)
    names = {"__name__": "__main__"}
    for block in blocks(page):
        assert block.language in LANGUAGES, (
            f"{block.place}: {block.language or 'no language'}; text is not run"
        )
        if block.reason:
            continue
        try:
            if block.language == "python":
                exec(compile(block.text, block.place, "exec"), names)
            for words in block.commands():
                if not " ".join(words).startswith(SKIPPED):
                    monkeypatch.setattr(sys, "argv", words[1:])
                    run(words)
        except (Exception, SystemExit) as error:
            pytest.fail(f"{block.place}: {error}")


def short(**settings):
    config = AdaptConfig(**settings)
    return replace(config, iters=min(config.steps, STEPS))


def run(words):
    words, out = (words[:-2], Path(words[-1])) if ">" in words else (words, Path("said.txt"))
    assert words[0] in ("clod-adapt", "python"), (
        f"{words[0]}: not known; mark the block with <!-- not run: REASON -->"
    )
    with out.open("w", encoding="utf-8") as stream, redirect_stdout(stream):
        if words[0] == "python":
            runpy.run_path(str(ROOT / words[1]), run_name="__main__")
            return
        if words[1] not in COMMANDS or words[1] == "robustness":
            at = words.index("--iters") if "--iters" in words else len(words)
            steps = min([STEPS, *map(int, words[at + 1 : at + 2])])
            words = [*words[:at], "--iters", str(steps), *words[at + 2 :]]
        code = main(accepted(words[1:]))
    assert code == 0, f"{words}: exit code {code}"


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_named_options_exist(page):
    """Also of commands that are not run; each reason for not running a block stands above it."""
    written = blocks(page)
    text = page.read_text("utf-8")
    commands = [command.split() for command in spoken(page, "clod-adapt")]
    for block in written:
        commands += block.commands()
    for words in commands:
        if words[0] == "clod-adapt":
            words = words[1 : words.index(">")] if ">" in words else words[1:]
            name = words[0] if words and words[0] in COMMANDS else ""
            build_parser(name).parse_args(words[1:] if name else words)
    shared = (ROOT / "benchmarks" / "common.py").read_text("utf-8")
    for line in spoken(page, "python benchmarks/"):
        script, *words = line.split()[1:]
        source = (ROOT / script).read_text("utf-8") + shared
        for option in re.findall(r"--[a-z][a-z-]*", " ".join(words)):
            assert f'"{option}"' in source, f"{page.name}: {line}: no {option}"
    for block in written:
        assert not block.reason or len(block.reason.split()) >= 3, f"{block.place}: {block.reason}"
    assert text.count("<!-- not run:") == sum(bool(block.reason) for block in written), page.name


DOCS = ROOT / "docs"
RESULTS = ROOT / "benchmarks" / "results"


def keys(value):
    """The keys of all objects in a value, except in ``config``, which the settings page lists."""
    if isinstance(value, dict):
        for name, entry in value.items():
            yield name
            yield from keys(entry) if name != "config" else ()
    elif isinstance(value, list):
        for entry in value:
            yield from keys(entry)


def test_every_field_of_the_reports_is_explained(desk, capsys, monkeypatch):
    explained = set(re.findall(r"`([a-z_0-9]+)`", (DOCS / "python.md").read_text("utf-8")))
    monkeypatch.chdir(desk)
    line = "eval pretrained_clod.ply --images scene --sv 1 3 --popping --quiet"
    capsys.readouterr()
    assert main(f"{line} --base pretrained.ply --against pretrained.ply --json".split()) == 0
    measured = json.loads(capsys.readouterr().out)
    adapted = json.loads(desk.joinpath("pretrained_clod.json").read_text("utf-8"))
    assert {"rows", "alignment", "frame_ms"} <= set(keys(adapted))
    assert {"ranked", "moved"} <= set(keys(measured))
    missing = (set(keys(adapted)) | set(keys(measured))) - explained
    assert not missing, f"docs/python.md does not explain {sorted(missing)}"


def cells(page):
    """The cells of the tables of a page, without emphasis."""
    rows = re.findall(r"^\|(.*)\|$", (DOCS / page).read_text("utf-8"), re.MULTILINE)
    return [cell.strip(" *") for cell in "|".join(rows).split("|")]


def measured(value):
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


def test_qualities_in_tables_are_measured():
    """A number of decibels, with or without the share kept, is one of benchmarks/results."""
    results = []
    for file in RESULTS.glob("*.jsonl"):
        results += map(json.loads, file.read_text("utf-8").splitlines())
    with (RESULTS / "robustness.csv").open(encoding="utf-8") as stream:
        results += csv.DictReader(stream)
    written = cells("method.md") + cells("performance.md")
    quality = re.compile(r"\d\d\.\d\d( @ \d+ ?%)?")
    told = {cell.replace(" %", "%") for cell in written if quality.fullmatch(cell)}
    assert len(told) > 50 and not told - set(measured(results))


SOURCES = [
    ROOT / "README.md",
    *(ROOT / "docs").glob("*.md"),
    *(ROOT / "cli").rglob("*.py"),
    *(ROOT / "clod_adapter").rglob("*.py"),
]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))


def test_no_line_installs_clod_adapter_from_the_index():
    for path in SOURCES:
        assert not re.search(r"pip install[^`\n]*clod-adapter", path.read_text("utf-8")), path


def test_help_names_the_installed_page(tmp_path, monkeypatch):
    ((folder, patterns),) = PROJECT["tool"]["setuptools"]["data-files"].items()
    assert patterns == ["docs/*.md"]
    assert all(url.startswith("https://") for url in PROJECT["project"]["urls"].values())
    assert command.manual() == ROOT / "docs" / "index.md"  # of the checkout
    elsewhere = tmp_path / "lib" / "cli" / "shared" / "command.py"
    monkeypatch.setattr(command, "__file__", str(elsewhere))
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(tmp_path))
    monkeypatch.setattr(command, "getuserbase", lambda: str(tmp_path))
    assert "manual:" not in command.parser_of(adapt, "clod-adapt").format_help()
    page = tmp_path / folder / "index.md"
    page.parent.mkdir(parents=True)
    page.touch()
    assert command.parser_of(adapt, "clod-adapt").format_help().endswith(f"\nmanual: {page}\n")


LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)|(?:href|src)=\"([^\"]+)\"")
FETCHED = re.compile(r"<(?!a\s|link\s[^>]*rel=\"?canonical)[^>]*\s(?:src|href)=\"?([^\s\">]+)")


def anchors(page):
    """The anchors of a page's headings, as Markdown's toc extension and GitHub make them."""
    found = set()
    for title in re.findall(r"^#+ +(.+?) *$", FENCE.sub("", page.read_text("utf-8")), re.MULTILINE):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title)
        plain = re.sub(r"[^\w\s-]", "", text).strip().lower()
        found.add(re.sub(r"[-\s]+", "-", plain))
    return found


def test_links_and_pictures_exist():
    texts = {page: page.read_text("utf-8") for page in PAGES}
    for page, text in texts.items():
        for target in (one or other for one, other in LINK.findall(FENCE.sub("", text))):
            if target.startswith(("https://", "http://")):
                continue
            file, _, anchor = target.partition("#")
            found = (page.parent / file).resolve() if file else page
            assert found.exists(), f"{page.name}: {target}: no such file"
            assert not anchor or anchor in anchors(found), f"{page.name}: {target}: no such heading"
    written = "".join(texts.values())
    for picture in (DOCS / "images").iterdir():
        assert picture.suffix == ".svg" or picture.name in written


def test_the_built_site(tmp_path, monkeypatch):
    """Built as by ``make docs``; a broken link is an error. Its search covers all pages and public
    names.
    """
    pytest.importorskip("mkdocs", reason="pip install '.[docs]'")
    site = tmp_path / "site"
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    monkeypatch.setattr(sys, "argv", ["make.py"])
    runpy.run_path("docs/make.py", run_name="__main__")
    build = import_module("mkdocs.__main__").cli
    done = CliRunner().invoke(build, ["build", "--site-dir", str(site)])
    warned = re.search("^WARNING(?!.*griffe: )", done.output, re.MULTILINE)
    assert done.exit_code == 0 and not warned, done.output
    for page in site.glob("*.html"):
        fetched = FETCHED.findall(page.read_text("utf-8"))
        far = [url for url in fetched if re.match(r"([a-z]+:)?//", url)]
        assert fetched and not far, f"{page.name} fetches {far}"
    for style in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(https?:)?//|@import", style.read_text("utf-8")), (
            style.name
        )
    index = json.loads((site / "search" / "search_index.json").read_text("utf-8"))
    entries = {entry["location"] for entry in index["docs"]}
    generated = {"commands.html", "settings.html", "names.html"}
    pages = {f"{page.stem}.html" for page in DOCS.glob("*.md")} | generated
    assert pages == {entry.partition("#")[0] for entry in entries}
    public = [getattr(clod_adapter, name) for name in clod_adapter.__all__]
    named = {f"names.html#{each.__module__}.{each.__name__}" for each in public}
    assert named | {f"commands.html#clod-adapt-{name}" for name in COMMANDS} <= entries
    assert (site / "search" / "search_index.js").is_file()  # for pages opened from a folder
    assert not list(site.rglob("*.py")) and not list(site.rglob("*.md"))
