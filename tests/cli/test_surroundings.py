"""The command on a full disk, without permissions, without what Windows and macOS lack, and with
odd files.

These have names that are not UTF-8, or are photographs that are none by their content.
"""

import json
import os
import shutil
import struct
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import pytest

from runs import STATE, contents, log_of, names

if sys.platform == "win32":
    pytest.skip("limits are those of POSIX", allow_module_level=True)
import resource


@contextmanager
def room(size):
    """Within the block files have at most so many bytes; a longer write fails, as on a full
    disk.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def assert_one_error(done):
    (error,) = (line for line in done.err.splitlines() if line.startswith("clod-adapt: error: "))
    assert "cannot be written" in error and done.out == ""


def test_full_disk_while_adapting(clod, attenuated, tmp_path):
    """One line, and unchanged files of an earlier run. Without room for the page the others are
    complete.
    """
    words = "BASE --images SCENE --iters 2 --max-sv 2 -o dial.ply"
    shutil.copytree(attenuated.parent, tmp_path, dirs_exist_ok=True)
    earlier = contents(tmp_path)
    report, adapter, ply = (
        len(earlier[tmp_path / f"dial.{suffix}"]) for suffix in ("json", "safetensors", "ply")
    )
    assert report < adapter < ply
    for size in (report // 2, (adapter + ply) // 2):
        with room(size):
            assert_one_error(clod(words, code=2))
        assert contents(tmp_path).items() >= earlier.items()  # the state may have room
        (tmp_path / STATE).unlink(missing_ok=True)
    with room(ply + 5000):
        report = (done := clod(words, "--report --json")).report
    assert "the page was not written: " in done.err and "page" not in report["outputs"]
    assert report["rows"]
    assert "the page was not" in report["notes"][-1]
    assert report == json.loads((tmp_path / "dial.json").read_text())
    now = contents(tmp_path)
    assert now.keys() == earlier.keys() and not any(now[name] == earlier[name] for name in now)


@pytest.mark.parametrize(
    "size, line",
    [
        (2000, "export DIAL -o x.ply"),
        (2000, "export DIAL -o x.html"),
        # the last file fits, and the first does not
        (12000, "export DIAL --levels 1,4,9 -o x.ply"),
        (1000, "render DIAL --images SCENE -o pictures"),
        (1000, "apply BASE ADAPTER -o x.ply"),
        (1000, "robustness BASE --images SCENE --iters 0 --max-sv 2 -o out"),
    ],
)
def test_full_disk(clod, tmp_path, size, line):
    (tmp_path / "x.html").write_bytes(b"earlier")
    with room(size):
        assert_one_error(clod(line, code=2))
    assert contents(tmp_path) == {tmp_path / "x.html": b"earlier"}


def test_full_disk_while_measuring(clod, tmp_path):
    """The rows are not lost with the page."""
    with room(1000):
        done = clod("eval DIAL --images SCENE --sv 1 --report x.html --json --quiet", code=2)
    assert "cannot be written" in done.report["error"]
    assert done.report["rows"]
    assert not contents(tmp_path)
    assert done.err == f"clod-adapt: error: {done.report['error']}\n"


# Root gives up its rights by entering a user namespace; it may read nothing there that its owner
# may not.
NO_ROOT = "" if os.geteuid() else "import ctypes; assert ctypes.CDLL(None).unshare(0x10000000) == 0"


@pytest.mark.parametrize(
    "path, mode, said",
    [
        ("base.ply", 0, "base.ply: cannot be read (Permission denied); check the path"),
        (
            "scene/images/001.png",
            0,
            "001.png: cannot be read (Permission denied); check the path and its permissions",
        ),
        ("scene/images", 0, "scene/images: cannot be read; check its permissions"),
        (
            "out",
            0o555,
            "out/dial.ply: folder out is not writable; choose another or change its permissions",
        ),
        (
            "out/dial.ply",
            0o444,
            "dial.ply: is write-protected; choose another output, or chmod u+w",
        ),
        (f"out/{STATE}", 0, f"{STATE}: is write-protected; choose another output, or chmod u+w"),
    ],
)
def test_without_permission(server, capture, tmp_path, path, mode, said):
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
    assert code == 2, log
    assert log.count("\n") == 1
    assert said in log
    assert names(tmp_path / "out") == before, log


COMMANDS = """
base.ply --images scene -o dial.ply --iters 2 --accept-loss
render dial.ply --images scene --sv 1 -o pictures
apply base.ply dial.safetensors -o again.ply
export dial.ply -o plain.spz
export dial.ply -o plain.html
"""


@pytest.mark.usefixtures("without_splat_transform")
def test_commands_without_posix(capture, tmp_path):
    """Files that are open are not renamed or removed."""
    paths = {"base.ply": str(capture.ply), "scene": str(capture.scene)}
    commands = []
    for line in COMMANDS.strip().splitlines():
        commands.append([paths.get(word, word) for word in f"{line} --quiet".split()])
    program = Path(__file__).with_name("without_posix.py")
    words = [sys.executable, str(program), json.dumps(commands)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {"dial.ply", "dial.json", "pictures", "plain.spz", "plain.html"} <= set(names(tmp_path))
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


ODD = "gr\udcfcn"  # Latin-1 for an umlaut, which is not UTF-8
OF_ODD_NAMES = """
ODD.ply --images ODD --iters 2 --max-sv 2 -o OUT.ply
eval ODD_dial.ply --images ODD --sv 1 --report OUT.html
render ODD_dial.ply --images ODD -o OUT
export ODD_dial.ply -o OUT_page.html
robustness ODD.ply --images ODD --iters 2 --max-sv 2 -o OUT_cells
"""


@pytest.mark.usefixtures("without_splat_transform", "blank_figure")
def test_names_that_are_not_utf8(clod, capture, attenuated, tmp_path):
    """Of a scene, its checkpoint and a file with a dial, their folder, and all outputs."""
    folder = tmp_path / ODD
    try:
        (folder / "out").mkdir(parents=True)
    except OSError:
        pytest.skip("the file system takes UTF-8 only")
    shutil.copytree(capture.scene, folder / ODD)
    for file, name in ((capture.ply, ".ply"), (attenuated, "_dial.ply")):
        shutil.copy(file, folder / f"{ODD}{name}")
    for line in OF_ODD_NAMES.strip().splitlines():
        words = line.replace("ODD", f"{ODD}/{ODD}").replace("OUT", f"{ODD}/out/{ODD}")
        done = clod(words, "--quiet --json")
        assert "gr\\xfcn/gr\\xfcn" in json.dumps(done.report).replace("\\\\", "\\")
    for path in folder.glob("out/*.[hj][ts][mo][ln]"):  # pages and reports
        assert "gr\\xfcn" in path.read_text("utf-8").replace("\\\\", "\\"), path


CONTENT = {
    "PostScript": (
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\nshowpage\n%%EOF\n"
    ),
    "GIF": b"GIF89a" + struct.pack("<HH", 64, 48) + bytes(40),
    "WMF": (
        b"\xd7\xcd\xc6\x9a\0\0"
        + struct.pack("<4hHLH", 0, 0, 64, 48, 72, 0, 0)
        + b"\x01\x00\x09\x00"
        + bytes(100)
    ),
    "PPM": b"P6 64 48 255\n" + bytes(3 * 64 * 48),
}


def test_photographs_that_are_none_start_no_program(clod, capture, tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", started := Mock(side_effect=OSError))
    shutil.copytree(capture.scene, tmp_path / "scene")
    for kind, content in CONTENT.items():
        (tmp_path / "scene" / "images" / "001.png").write_bytes(content)
        done = clod("eval BASE --images scene --quiet", code=2)
        unknown = "damaged or none of PNG, JPEG, TIFF, WEBP, BMP"
        why = kind if kind in ("PostScript", "GIF") else unknown
        said = f"images/001.png: cannot be decoded, is {why}; export it as JPEG or PNG\n"
        assert done.err.endswith(said)
        assert done.err.count("\n") == 1 and not started.called, kind
