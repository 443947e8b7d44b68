from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

from clod_adapter.adapter import attach
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import blank, load, save
from clod_adapter.io.file_formats import PLY, READERS, check_readable, file_has_dial, reader_of
from scenes import gaussians


@pytest.mark.parametrize("suffix", READERS)
def test_the_functions_of_the_table_are_there(suffix: str) -> None:
    reader = READERS[suffix]
    module = import_module(f"clod_adapter.io.{reader.module}")
    for name in filter(None, (reader.read, reader.check, reader.has_dial)):
        assert callable(getattr(module, name))


def test_the_name_alone_decides() -> None:
    assert reader_of(Path("a.PT")) is READERS[".pt"]
    assert reader_of(Path("a.compressed.ply")) is reader_of(Path("noname")) is PLY


@pytest.mark.parametrize("suffix", READERS)
def test_what_is_not_there_is_refused_in_one_line(tmp_path: Path, suffix: str) -> None:
    for read in (check_readable, load):
        with pytest.raises(ClodError, match=f"missing{suffix}: cannot be read .No such file"):
            read(tmp_path / f"missing{suffix}")


def test_dials_are_seen_by_the_header(tmp_path: Path) -> None:
    plain = gaussians(3, 1, 0)
    save(tmp_path / "plain.ply", plain, blank(3, 1))
    save(tmp_path / "dial.ply", attach(plain), blank(3, 1))
    assert file_has_dial(tmp_path / "dial.ply") and not file_has_dial(tmp_path / "plain.ply")
