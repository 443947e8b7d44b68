"""Outputs appear whole or not at all, and of two runs one writes; names of files as text."""

import os
import stat
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
from refusals import refused

from clod_adapter._support.text import as_text, file_name
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path, atomic_paths, output_lock, remove_leftovers


def test_temporaries_of_a_file_are_removed(tmp_path):
    """Nested ones too, but none of another file."""
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


def test_file_appears_only_after_success(tmp_path, monkeypatch):
    """A folder that cannot be flushed does not matter."""
    final = tmp_path / ("x" * 251 + ".ply")  # as long as a name may be
    with atomic_path(final) as temporary, atomic_path(temporary) as nested:
        assert temporary.parent == tmp_path and temporary.suffix == ".ply"
        nested.write_bytes(b"old")
        assert not final.exists()
    fsync = os.fsync

    def refuse(handle):
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(22, "Invalid argument")
        fsync(handle)

    monkeypatch.setattr(os, "fsync", refuse)
    with atomic_path(final) as temporary:
        temporary.write_bytes(b"new")
        assert final.read_bytes() == b"old"
    assert final.read_bytes() == b"new" and os.listdir(tmp_path) == [final.name]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left")])
def test_failure_keeps_only_the_old_files(tmp_path, error):
    finals = tmp_path / "a", tmp_path / "out"
    with atomic_paths(*finals) as temporaries:
        for temporary in temporaries:
            assert not os.path.exists(finals[0]) and not os.path.exists(finals[1])
            temporary.write_bytes(b"old")
    with (
        pytest.raises(
            (ClodError, KeyboardInterrupt), match=r"^$|.*/out: cannot be written: No space left$"
        ),
        atomic_paths(*finals) as (first, second),
        atomic_path(second) as temporary,
    ):
        first.write_bytes(b"new")
        temporary.write_bytes(b"half")
        raise error
    with refused("cannot be written"), atomic_paths(*finals) as (first, _):
        first.write_bytes(b"new")  # and the other not at all
    assert [final.read_bytes() for final in finals] == [b"old", b"old"]
    assert len(os.listdir(tmp_path)) == 2


@pytest.mark.parametrize("links", [True, False])
def test_several_files_are_replaced_together(tmp_path, monkeypatch, links):
    """A folder made in place of the last one keeps the others as they were; also without hard
    links.
    """
    if not links:
        monkeypatch.setattr(os, "link", Mock(side_effect=OSError(1, "Operation not permitted")))
    old, absent, last = (tmp_path / name for name in ("old", "absent", "last"))
    old.write_bytes(b"old")
    with (
        refused(r"last: cannot be written"),
        atomic_paths(old, absent, last) as temporaries,
    ):
        for temporary in temporaries:
            temporary.write_bytes(b"new")
        last.mkdir()
    assert old.read_bytes() == b"old" and sorted(os.listdir(tmp_path)) == ["last", "old"]


def test_unwritable_targets_are_refused(tmp_path, monkeypatch):
    """A write-protected file is not replaced, although a rename needs the folder's permission
    only.
    """
    target = tmp_path / "full" / "a.txt"
    target.parent.mkdir()
    target.write_text("earlier")
    target.chmod(0o444)
    for path, message in (
        (target, "a.txt: is write-protected; choose another output"),
        (tmp_path / "no" / "out", "does not exist"),
        (target.parent, "not empty"),
        (Path("/"), "is a mount point"),
        (tmp_path / "out", "not writable"),
    ):
        if message == "not writable":
            # root may write anywhere, so chmod proves nothing
            monkeypatch.setattr(os, "access", lambda *_: False)
        with refused(message), atomic_path(path):
            raise AssertionError("the body must not run")
    assert target.read_text() == "earlier" and list(tmp_path.iterdir()) == [target.parent]


HOLD = """
import os, sys, time
from pathlib import Path
from clod_adapter.io.atomic import output_lock
with output_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_lock_keeps_other_processes_out_until_its_own_is_killed(tmp_path):
    final = tmp_path / "out.ply"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(final)], stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout.readline() == "held\n"
    remove_leftovers(final)  # as a second run would
    for path, name in ((final, final), (tmp_path / "OUT.ply", Path("all"))):
        with (
            refused(f"^{name}: another run is writing it; wait for that"),
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


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("garden.ply", "garden.ply"),
        ("gärten/日本.ply", "gärten/日本.ply"),
        ("\udcc3\udca4.ply", "ä.ply"),  # under an ASCII locale
        ("a\udcff.ply", "a\\xff.ply"),
        ("ä\udcff\ud800.ply", "ä\\udcff\\ud800.ply"),
    ],
)
def test_names_as_text(name, text):
    assert as_text(name) == text and text.encode()


def test_names_on_disk_and_in_errors():
    assert os.fsencode(file_name("gärten/日本.ply")) == "gärten/日本.ply".encode()
    assert str(ClodError("a\udcff.ply: is damaged\x1b[2J")) == "a\\xff.ply: is damaged [2J"
