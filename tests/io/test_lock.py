from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import lock_file, remove_leftovers
from clod_adapter.io.lock import output_lock

fcntl = pytest.importorskip("fcntl", reason="locks are those of POSIX")
HOLD = """
import os, sys, time
from pathlib import Path
from clod_adapter.io.lock import output_lock
with output_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_lock_keeps_other_processes_out_until_its_own_is_killed(tmp_path: Path) -> None:
    final = tmp_path / "out.ply"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(final)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None and holder.stdout.readline() == "held\n"
    remove_leftovers(final)  # as a second run would
    for path, name in ((final, final), (tmp_path / "OUT.ply", Path("all"))):
        with (
            pytest.raises(ClodError, match=f"^{name}: another run is writing it; wait for that"),
            output_lock(path, of=name),
        ):
            raise AssertionError("the body must not run")
    with output_lock(tmp_path / "other.ply"):
        pass
    holder.kill()
    holder.wait()
    holder.stdout.close()
    with output_lock(final):
        assert len(os.listdir(tmp_path)) == 1
    assert os.listdir(tmp_path) == []


def test_file_system_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with output_lock(tmp_path / "out.ply"), output_lock(tmp_path / "out.ply"):
        assert os.listdir(tmp_path) == []


def test_the_lock_of_another_user_keeps_out_and_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a shared folder; root, who may run this, can open every file."""

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    lock_file(tmp_path / "out.ply").touch()
    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(ClodError, match="another run is writing it"), output_lock(tmp_path / "out.ply"):
        raise AssertionError("the body must not run")
    assert lock_file(tmp_path / "out.ply").exists()
