from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import remove_leftovers
from clod_adapter.io.lock import output_lock

fcntl = pytest.importorskip("fcntl", reason="locks are those of POSIX")


def test_killed_process_releases_the_lock(tmp_path: Path) -> None:
    final = tmp_path / "out.ply"
    code = (
        "import os, sys; from pathlib import Path; from clod_adapter.io.lock import output_lock\n"
        "with output_lock(Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(final)], check=False).returncode == -9
    assert len(os.listdir(tmp_path)) == 1
    with output_lock(final):
        pass
    assert os.listdir(tmp_path) == []


def test_file_system_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with output_lock(tmp_path / "out.ply"), output_lock(tmp_path / "out.ply"):
        assert os.listdir(tmp_path) == []


def test_lock_file_removed_by_the_last_holder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Then the lock is taken on a new file."""
    lock, removed = fcntl.flock, []

    def late(handle: int, how: int) -> None:
        lock(handle, how)
        if not removed:
            removed.extend(tmp_path.iterdir())
            removed[0].unlink()

    monkeypatch.setattr(fcntl, "flock", late)
    with (
        output_lock(tmp_path / "out.ply"),
        pytest.raises(ClodError, match="another run"),
        output_lock(tmp_path / "out.ply"),
    ):
        raise AssertionError("the body must not run")
    assert removed and os.listdir(tmp_path) == []


def refused(path: Path, **how: Any) -> None:
    message = rf"^{how.get('of', path)}: another run \(process {os.getpid()}\) is writing it; wait for that"
    with pytest.raises(ClodError, match=message), output_lock(path, **how):
        raise AssertionError("the body must not run")


def test_exclusive_and_shared_locks(tmp_path: Path) -> None:
    final = tmp_path / "out.ply"
    with output_lock(final), output_lock(tmp_path / "other.ply"):
        remove_leftovers(final)  # as a second run would
        refused(final)
        refused(final, of=Path("all"), shared=True)
    assert os.listdir(tmp_path) == []
    with output_lock(final, shared=True):
        with output_lock(final, shared=True):
            pass
        refused(final)
    assert os.listdir(tmp_path) == []
