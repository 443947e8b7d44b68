"""The page in a real browser: one Chromium for all tests, a server for each file that is shown."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from shown import SIZE, Shown, serve


@pytest.fixture
def artefacts(tmp_path: Path) -> Path:
    """Where pictures are kept for a look: CLOD_ARTIFACTS, or the test's own folder."""
    folder = Path(os.environ.get("CLOD_ARTIFACTS", tmp_path))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture
def show(chromium: Any) -> Iterator[Callable[..., Shown]]:
    """Shows the files of a ``clod-adapt view`` command line; an error in the console fails the test."""
    with ExitStack() as stack:
        opened: list[tuple[Shown, str]] = []

        def start(*words: object, address: str = "", **options: Any) -> Shown:
            url = stack.enter_context(serve(*words))
            context = stack.enter_context(chromium.new_context(**({"viewport": SIZE} | options)))
            context.set_default_timeout(10_000)
            shown = Shown(context.new_page())
            opened.append((shown, url))
            return shown.ready(url + address)

        yield start
        for shown, url in opened:
            assert shown.errors == []
            elsewhere = [each for each in shown.asked if not each.startswith((url, "data:", f"blob:{url}"))]
            assert elsewhere == []


@dataclass(frozen=True)
class Files:
    """Ways to write a scene for a test."""

    folder: Path

    def save(self, gaussians: clod_adapter.Gaussians, name: str = "model.ply") -> Path:
        clod_adapter.save(self.folder / name, gaussians)
        return self.folder / name


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path)
