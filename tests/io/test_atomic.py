from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path, atomic_paths, remove_leftovers


def test_appears_only_after_success(tmp_path: Path) -> None:
    final = tmp_path / "out.ply"
    with atomic_path(final) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".ply"
        temporary.write_bytes(b"new")
        assert not final.exists()
    assert final.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["out.ply"]


def test_replaces_a_file(tmp_path: Path) -> None:
    final = tmp_path / "out"
    final.write_bytes(b"old")
    with atomic_path(final) as temporary:
        temporary.write_bytes(b"new")
    assert final.read_bytes() == b"new"


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path, error: type[BaseException]) -> None:
    final = tmp_path / "out"
    final.write_bytes(b"old")
    with pytest.raises(error), atomic_path(final) as temporary:
        temporary.write_bytes(b"half")
        raise error
    assert final.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out"]


def test_full_disk_is_a_clod_error(tmp_path: Path) -> None:
    with pytest.raises(ClodError, match="No space left"), atomic_path(tmp_path / "out"):
        raise OSError(28, "No space left on device")
    assert os.listdir(tmp_path) == []


def test_a_folder_that_cannot_be_flushed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rename is done by then, so the file is written."""
    fsync = os.fsync

    def refuse(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(22, "Invalid argument")
        fsync(handle)

    monkeypatch.setattr(os, "fsync", refuse)
    with atomic_path(tmp_path / "out") as temporary:
        temporary.write_bytes(b"new")
    assert (tmp_path / "out").read_bytes() == b"new"


def test_folders(tmp_path: Path) -> None:
    final = tmp_path / "model"
    with atomic_path(final) as temporary:
        (temporary / "deep").mkdir(parents=True)
        (temporary / "deep" / "a").write_bytes(b"a")
    assert (final / "deep" / "a").read_bytes() == b"a"
    with pytest.raises(ClodError, match="not empty"), atomic_path(final):
        raise AssertionError("the body must not run")
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "other") as temporary:
        (temporary / "deep").mkdir(parents=True)
        raise RuntimeError
    assert os.listdir(tmp_path) == ["model"]


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(ClodError, match="does not exist"), atomic_path(tmp_path / "no" / "out"):
        raise AssertionError("the body must not run")


def test_unwritable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere, so chmod proves nothing
    with pytest.raises(ClodError, match="not writable"), atomic_path(tmp_path / "out"):
        raise AssertionError("the body must not run")


def test_several_appear_together(tmp_path: Path) -> None:
    finals = [tmp_path / name for name in ("a", "b", "c")]
    with atomic_paths(*finals) as temporaries:
        for temporary in temporaries:
            assert os.listdir(tmp_path) == [] or not any(final.exists() for final in finals)
            temporary.write_bytes(b"new")
    assert sorted(os.listdir(tmp_path)) == ["a", "b", "c"]
    with pytest.raises(ClodError, match="cannot be written"), atomic_paths(*finals) as temporaries:
        temporaries[0].write_bytes(b"newer")  # and the others not at all
    assert [final.read_bytes() for final in finals] == [b"new"] * 3


def test_errors_name_the_final_file(tmp_path: Path) -> None:
    with (
        pytest.raises(ClodError, match=r"^.*/b: cannot be written: No space left on device$"),
        atomic_paths(tmp_path / "a", tmp_path / "b") as (_, second),
        atomic_path(second),
    ):
        raise OSError(28, "No space left on device")
    assert os.listdir(tmp_path) == []


def test_leftovers_of_the_same_file_are_removed(tmp_path: Path) -> None:
    """Of a temporary's temporary too; what belongs to another file stays."""
    final, other = tmp_path / "out.ply", tmp_path / "other.ply"
    final.write_bytes(b"final")
    with atomic_path(final) as first, atomic_path(other) as theirs:
        with atomic_path(first) as nested:
            nested.write_bytes(b"half")
            theirs.write_bytes(b"half")
            remove_leftovers(final)
            assert sorted(os.listdir(tmp_path)) == sorted(["out.ply", theirs.name])
            nested.write_bytes(b"new")
        first.write_bytes(b"new")
    assert final.read_bytes() == b"new"


def test_a_long_name(tmp_path: Path) -> None:
    final = tmp_path / ("x" * 251 + ".ply")
    with atomic_path(final) as temporary, atomic_path(temporary) as nested:
        nested.write_bytes(b"new")
    assert final.read_bytes() == b"new"


def test_a_write_protected_file_is_not_replaced(tmp_path: Path) -> None:
    """Not by root either, who may write to any file, and although a rename asks for the folder's permission only."""
    target = tmp_path / "a.txt"
    target.write_text("earlier")
    target.chmod(0o444)
    with pytest.raises(ClodError, match="a.txt: is write-protected; choose another output"), atomic_path(target):
        pass
    assert target.read_text() == "earlier" and list(tmp_path.iterdir()) == [target]
