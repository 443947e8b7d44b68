"""The command on a full disk, without permissions, and without what Windows and macOS lack."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from runs import STATE, Server, log_of, names

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


def test_full_disk_while_adapting(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """One line, and unchanged files of an earlier run. Without room for the page the others are complete."""
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
def test_full_disk(clod: Any, capture: Any, dialled: Path, tmp_path: Path, size: int, line: str) -> None:
    (tmp_path / "x.html").write_bytes(b"earlier")
    places = {"DIAL": dialled.with_suffix(""), "SCENE": capture.scene, "BASE": capture.ply}
    for name, path in places.items():
        line = line.replace(name, str(path))
    with room(size):
        assert_one_error(clod(*line.split()))
    assert held(tmp_path) == {"x.html": b"earlier"}


# Root gives up its rights by entering a user namespace; it may read nothing there that its owner may not.
NO_ROOT = "" if os.geteuid() else "import ctypes; assert ctypes.CDLL(None).unshare(0x10000000) == 0"


@pytest.mark.parametrize(
    ("path", "mode", "said"),
    [
        ("base.ply", 0, "base.ply: cannot be read (Permission denied); check the path"),
        ("scene/images/001.png", 0, "001.png: cannot be read (Permission denied); check its permissions"),
        ("scene/images", 0, "scene/images: cannot be read; check its permissions"),
        ("out", 0o555, "out/dial.ply: folder out is not writable; choose another or change its permissions"),
        ("out/dial.ply", 0o444, "dial.ply: is write-protected; choose another output, or chmod u+w"),
        (f"out/{STATE}", 0, f"{STATE}: is write-protected; choose another output, or chmod u+w"),
    ],
)
def test_files_without_permission(
    server: Server, capture: Any, tmp_path: Path, path: str, mode: int, said: str
) -> None:
    """As of another user: one line, before any work."""
    shutil.copytree(capture.scene.parent, tmp_path, dirs_exist_ok=True)
    (tmp_path / "out").mkdir()
    (tmp_path / path).touch()
    before = names(tmp_path / "out")
    (tmp_path / path).chmod(mode)
    words = ("base.ply", "--images", "scene", "--out", "out/dial.ply", "--resume", "--quiet")
    code = server.wait(server.start(tmp_path, *words, before=NO_ROOT))
    (tmp_path / path).chmod(0o755)
    log = log_of(tmp_path)
    if NO_ROOT and code == 1 and not log:
        pytest.skip("root cannot give up its rights here")
    assert code == 2 and log.count("\n") == 1 and said in log and names(tmp_path / "out") == before, log


COMMANDS = """
base.ply --images scene -o dial.ply --iters 2 --accept-loss
render dial.ply --images scene --sv 1 -o pictures
apply base.ply dial.safetensors -o again.ply
export dial.ply -o plain.spz
export dial.ply -o plain.html
"""


@pytest.mark.usefixtures("without_splat_transform")
def test_commands_without_posix(capture: Any, tmp_path: Path) -> None:
    """Files that are open are not renamed or removed."""
    paths = {"base.ply": str(capture.ply), "scene": str(capture.scene)}
    commands = [[*(paths.get(w, w) for w in line.split()), "--quiet"] for line in COMMANDS.strip().splitlines()]
    program = Path(__file__).with_name("without_posix.py")
    words = [sys.executable, str(program), json.dumps(commands)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {"dial.ply", "dial.json", "pictures", "plain.spz", "plain.html"} <= set(names(tmp_path))
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
