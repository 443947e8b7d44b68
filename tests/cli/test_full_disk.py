"""A full disk at any write: one line, exit code 2, unchanged files of an earlier run."""

import json
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

if sys.platform == "win32":
    pytest.skip("limits are those of POSIX", allow_module_level=True)
import resource

EXPORT_LEVELS = "export DIAL.ply --levels 1,4,9 -o x.ply"  # the last file fits, and the first does not


@contextmanager
def room(size: int) -> Iterator[None]:
    """Within the block files have at most so many bytes; a longer write fails, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def held(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_one_error(done: Any) -> None:
    assert done.code == 2 and done.out == "", done
    errors = [line for line in done.err.splitlines() if line.startswith("clod-adapt: error: ")]
    assert len(errors) == 1 and "cannot be written" in errors[0], done


def test_adapt(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """At the report and the PLY. Without room for the page the others are complete."""
    words = (capture.ply, "--images", capture.scene, "--iters", 2, "--max-sv", 2, "-o", "dial.ply")
    shutil.copytree(dialled.parent, tmp_path, dirs_exist_ok=True)
    earlier = held(tmp_path)
    report, adapter, ply = (len(earlier[f"dial.{suffix}"]) for suffix in ("json", "safetensors", "ply"))
    assert report < adapter < ply
    for size in (report // 2, (adapter + ply) // 2):
        with room(size):
            assert_one_error(clod(*words))
        assert held(tmp_path) == earlier
    with room(ply + 5000):
        done = clod(*words, "--report", "--json")
    report = json.loads(done.out)
    assert done.code == 0 and "the page was not written: " in done.err and "page" not in report["outputs"]
    assert report["rows"] and report["seconds"]["page"] > 0 and "the page was not" in report["notes"][-1]
    assert report == json.loads((tmp_path / "dial.json").read_text())
    now = held(tmp_path)
    assert now.keys() == earlier.keys() and not any(now[name] == earlier[name] for name in now)


@pytest.mark.parametrize(
    ("size", "line"),
    [
        (2000, "export DIAL.ply -o x.ply"), (2000, "export DIAL.ply -o x.html"), (20000, EXPORT_LEVELS),
        (1000, "render DIAL.ply --images SCENE -o pictures"), (1000, "apply BASE DIAL.safetensors -o x.ply"),
        (1000, "robustness BASE --images SCENE --iters 0 --max-sv 2 -o out"),
    ],
)  # fmt: skip
def test_other_commands(clod: Any, capture: Any, dialled: Path, tmp_path: Path, size: int, line: str) -> None:
    (tmp_path / "x.html").write_bytes(b"earlier")
    places = {"DIAL": dialled.with_suffix(""), "SCENE": capture.scene, "BASE": capture.ply}
    for name, path in places.items():
        line = line.replace(name, str(path))
    with room(size):
        assert_one_error(clod(*line.split()))
    assert held(tmp_path) == {"x.html": b"earlier"}
