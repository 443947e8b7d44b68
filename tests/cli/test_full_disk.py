"""A full disk at any write: one line, exit code 2, unchanged files of an earlier run."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from clod_adapter.report import page

if sys.platform == "win32":
    pytest.skip("limits are those of POSIX", allow_module_level=True)
import resource

Room = Callable[[int], Any]


@pytest.fixture
def room() -> Room:
    """Within the block files have at most so many bytes; a longer write fails, as on a full disk."""

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


def held(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def one_error(done: Any) -> str:
    assert done.code == 2 and done.out == "", done
    errors = [line for line in done.err.splitlines() if line.startswith("clod-adapt: error: ")]
    assert len(errors) == 1 and "cannot be written" in errors[0], done
    return errors[0]


def test_adapt(clod: Any, capture: Any, tmp_path: Path, room: Room) -> None:
    """At each of the three files. Without room for the page the others are complete."""
    words = (capture.ply, "--images", capture.scene, "--iters", 2, "--max-sv", 2, "-o", "dial.ply")
    assert clod(*words, "--seed", 5).code == 0
    earlier = held(tmp_path)
    report, adapter, ply = (len(earlier[f"dial.{suffix}"]) for suffix in ("json", "safetensors", "ply"))
    assert report < adapter < ply
    for size in (report // 2, (adapter + ply) // 2):
        with room(size):
            one_error(clod(*words))
        assert held(tmp_path) == earlier
    with room(ply + 5000):
        done = clod(*words, "--report", "--json")
    report = json.loads(done.out)
    assert done.code == 0 and "the page was not written: " in done.err and "page" not in report["outputs"]
    assert report["rows"] and report["seconds"]["page"] > 0 and "the page was not" in report["notes"][-1]
    assert report == json.loads((tmp_path / "dial.json").read_text())
    now = held(tmp_path)
    assert now.keys() == earlier.keys() and not any(now[name] == earlier[name] for name in now)


def test_page(
    clod: Any, capture: Any, dialled: Path, tmp_path: Path, room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The earlier page and charts stay, also if there is room for the charts."""
    words = ("eval", dialled, "--images", capture.scene, "--sv", 1, "--report", "page.html")
    assert clod(*words).code == 0
    earlier = held(tmp_path)
    real, limits = page.as_text, ExitStack()

    def later(text: str) -> str:  # the last call before the page is written
        limits.enter_context(room(100))
        return str(real(text))

    monkeypatch.setattr(page, "as_text", later)
    with limits:
        done = clod(*words)
    assert done.code == 0 and "the page was not written: " in done.err and "File too large" in done.err, done
    assert held(tmp_path) == earlier


@pytest.mark.parametrize("name", ["x.ply", "x.glb", "x.html"])
def test_exports(clod: Any, dialled: Path, tmp_path: Path, room: Room, name: str) -> None:
    (tmp_path / name).write_bytes(b"earlier")
    with room(2000):
        one_error(clod("export", dialled, "-o", name))
    assert held(tmp_path) == {name: b"earlier"}


def test_render_and_apply(clod: Any, capture: Any, dialled: Path, tmp_path: Path, room: Room) -> None:
    with room(1000):
        one_error(clod("render", dialled, "--images", capture.scene, "-o", "pictures"))
        one_error(clod("apply", capture.ply, dialled.with_suffix(".safetensors"), "-o", "x.ply"))
    assert list(tmp_path.iterdir()) == []


def test_robustness(clod: Any, capture: Any, tmp_path: Path, room: Room) -> None:
    words = ("robustness", capture.ply, "--images", capture.scene, "--iters", 2, "--max-sv", 2, "-o", "out")
    for size in (1000, 12000):  # the first cell, and one of the next ones or the figure
        with room(size):
            one_error(clod(*words))
        assert not any(path.name.startswith(".") for path in tmp_path.rglob("*"))
    assert clod(*words).code == 0
