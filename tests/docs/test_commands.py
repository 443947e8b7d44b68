"""Every command in the documentation parses, and runs unless its block states a reason."""

import re
import runpy
import shutil
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli.main import COMMANDS, build_parser, main
from clod_adapter.config import AdaptConfig
from fences import PAGES, ROOT, blocks, spoken
from runs import accepted

IDS = [str(page.relative_to(ROOT)) for page in PAGES]
LANGUAGES = {"sh", "console", "python", "text", "json", "glsl", "wgsl", "html", "css", "js"}
STEPS = 20  # of a training that the pages run, at most
# Commands that are not run: two change the environment that the tests run in, and one takes a minute (test_demo.py).
SKIPPED = ("pip", "make", "clod-adapt demo")


@pytest.mark.usefixtures("without_splat_transform")
@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_blocks_run_in_the_order_of_the_page(page: Path, desk: Path, tmp_path: Path, monkeypatch: Any) -> None:
    """Training is shortened."""
    shutil.copytree(desk, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(clod_adapter, "AdaptConfig", short)
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(page):
        assert block.language in LANGUAGES, f"{block.place}: {block.language or 'no language'}; text is not run"
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


def short(**settings: Any) -> AdaptConfig:
    """Settings of a Python block."""
    config = AdaptConfig(**settings)
    return replace(config, iters=min(config.steps, STEPS))


def run(words: list[str]) -> None:
    """Runs a command of a shell block in the current folder."""
    words, out = (words[:-2], Path(words[-1])) if ">" in words else (words, Path("said.txt"))
    assert words[0] in ("clod-adapt", "python"), f"{words[0]}: not known; mark the block with <!-- not run: REASON -->"
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
def test_named_options_exist(page: Path) -> None:
    """Also of commands that are not run; each reason for not running a block stands above it."""
    written, text = blocks(page), page.read_text(encoding="utf-8")
    said = [command.split() for command in spoken(page, "clod-adapt")]
    for words in [*said, *(words for block in written for words in block.commands())]:
        if words[0] == "clod-adapt":
            words = words[1 : words.index(">")] if ">" in words else words[1:]
            name = words[0] if words and words[0] in COMMANDS else ""
            build_parser(name).parse_args(words[1:] if name else words)
    shared = (ROOT / "benchmarks" / "common.py").read_text(encoding="utf-8")
    for command in spoken(page, "python benchmarks/"):
        script, *words = command.split()[1:]
        source = (ROOT / script).read_text(encoding="utf-8") + shared
        for option in re.findall(r"--[a-z][a-z-]*", " ".join(words)):
            assert f'"{option}"' in source, f"{page.name}: {command}: no {option}"
    for block in written:
        assert not block.reason or len(block.reason.split()) >= 3, f"{block.place}: {block.reason}"
    assert text.count("<!-- not run:") == sum(bool(block.reason) for block in written), page.name
