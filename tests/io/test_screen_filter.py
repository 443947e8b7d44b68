"""The screen-space filter in files of other programs and in columns; for other settings see test_settings."""

from __future__ import annotations

import zlib
from pathlib import Path

import pytest

from clod_adapter.adapter import detach
from clod_adapter.config import CLASSIC, FILTERS, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import write
from clod_adapter.io.settings import implied_filter, is_antialiased, tagged
from formats import model, without_comments


def test_comments_of_other_programs_are_corrected() -> None:
    mixed = ["made by hand", "SplatRenderMode: default", "antialiased 0"]
    assert tagged(mixed, CLASSIC) == mixed
    assert tagged(mixed, FILTERS["on"]) == ["made by hand", "SplatRenderMode: mip"]
    for comment in ("SplatRenderMode: mip", "antialiased 1"):
        assert tagged(["made by hand", comment], FILTERS["on"]) == ["made by hand", comment]
        assert tagged(["made by hand", comment], CLASSIC) == ["made by hand"]


def test_spz_flag(tmp_path: Path) -> None:
    """Bit 0: written with every compensating filter; other programs store nothing else."""

    def flags(path: Path) -> bytearray:
        return bytearray(zlib.decompress(path.read_bytes(), wbits=31))

    plain = detach(model(1))
    for screen_filter, want in ((CLASSIC, 2), (FILTERS["on"], 3), (FILTERS["mip"], 3), (ScreenFilter(variance=1), 2)):
        write(tmp_path / "a.spz", plain.replace(screen_filter=screen_filter))
        assert flags(tmp_path / "a.spz")[14] == want
    write(tmp_path / "a.spz", plain)
    data = flags(tmp_path / "a.spz")
    data[14] |= 1
    gzip = zlib.compressobj(wbits=31)
    (tmp_path / "b.spz").write_bytes(gzip.compress(bytes(data)) + gzip.flush())
    found = load(tmp_path / "b.spz")
    assert found.gaussians.screen_filter == FILTERS["on"] and not found.filter_known
    assert is_antialiased(found.comments)


def test_filter_of_a_dial_is_that_of_its_settings(tmp_path: Path) -> None:
    """It takes precedence over a comment of another program."""
    write(tmp_path / "a.ply", model(1))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"end_header", b"comment antialiased 1\nend_header", 1))
    found = load(tmp_path / "a.ply")
    assert found.gaussians.screen_filter == CLASSIC and found.filter_known
    save(tmp_path / "b.ply", detach(found.gaussians), found)
    assert not is_antialiased(load(tmp_path / "b.ply").comments)


def test_filters_of_other_programs() -> None:
    assert not is_antialiased(["SplatRenderMode: default", "antialiased 0", "not antialiased 1"])
    assert implied_filter((), ("x", "y")) == implied_filter(("antialiased 0",), ()) == CLASSIC
    assert implied_filter(("Exported from Brush", "SplatRenderMode: mip"), ()) == FILTERS["mip"]  # Brush's has 0.1 px^2
    assert implied_filter(("SplatRenderMode: mip",), ()) == implied_filter(("x", "antialiased 1"), ()) == FILTERS["on"]


@pytest.mark.parametrize("screen_filter", [*FILTERS.values(), ScreenFilter(variance=0.123, compensate=True)], ids=str)
def test_columns_store_the_filter(tmp_path: Path, screen_filter: ScreenFilter) -> None:
    """In a file with a dial; a plain one has no columns but those of Inria's layout."""
    write(tmp_path / "a.ply", model(1).replace(screen_filter=screen_filter))
    found = load(without_comments(tmp_path / "a.ply"))
    assert found.gaussians.screen_filter == screen_filter and found.filter_known and found.comments == ()
    write(tmp_path / "b.ply", detach(found.gaussians))
    assert not any(name.startswith("clod_") for name in load(tmp_path / "b.ply").vertex.dtype.names or ())


def test_columns_of_other_programs_and_damaged_columns(tmp_path: Path) -> None:
    write(tmp_path / "a.ply", detach(model(1)))
    found = load(without_comments(tmp_path / "a.ply", filter_3D=0.01))  # of Mip-Splatting
    assert found.gaussians.screen_filter == FILTERS["mip"] and not found.filter_known
    save(tmp_path / "b.ply", found.gaussians, found)  # without the column, which is fused
    assert load(tmp_path / "b.ply").gaussians.screen_filter == FILTERS["mip"]
    write(tmp_path / "a.ply", model(1))
    with pytest.raises(ClodError, match=r"rewritten.ply: its settings are damaged \(variance is -1.0"):
        load(without_comments(tmp_path / "a.ply", clod_screen_variance=-1.0))
