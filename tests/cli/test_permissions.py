"""Inputs that may not be read, outputs that may not be written, as of another user: one line, before any work."""

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from runs import STATE, Server, log_of, names

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
