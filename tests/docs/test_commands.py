"""Every command in the documentation parses, and runs unless its block states a reason."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.config import AdaptConfig
from fences import LANGUAGES, PAGES, ROOT, SHELL, STEPS, blocks, parse, run, skipped, spoken

IDS = [str(page.relative_to(ROOT)) for page in PAGES]


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
            elif block.language in SHELL:
                for words in block.commands():
                    if not skipped(words):
                        run(words)
        except (Exception, SystemExit) as error:
            pytest.fail(f"{block.place}: {error}")


def short(**settings: Any) -> AdaptConfig:
    """Settings of a Python block, trained for STEPS steps at most."""
    config = AdaptConfig(**settings)
    return replace(config, iters=min(config.steps, STEPS))


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_named_options_exist(page: Path) -> None:
    """Also of commands that are not run; each reason for not running a block stands above it."""
    written, text = blocks(page), page.read_text(encoding="utf-8")
    commands = [words for block in written if block.language in SHELL for words in block.commands()]
    for words in [*commands, *(command.split() for command in spoken(page, "clod-adapt"))]:
        if words[0] == "clod-adapt":
            parse(words)
    shared = (ROOT / "benchmarks" / "common.py").read_text(encoding="utf-8")
    for command in spoken(page, "python benchmarks/"):
        script, *words = command.split()[1:]
        source = (ROOT / script).read_text(encoding="utf-8") + shared
        for option in re.findall(r"--[a-z][a-z-]*", " ".join(words)):
            assert f'"{option}"' in source, f"{page.name}: {command}: no {option}"
    for block in written:
        assert not block.reason or len(block.reason.split()) >= 3, f"{block.place}: {block.reason}"
    assert text.count("<!-- not run:") == sum(bool(block.reason) for block in written), page.name
