from __future__ import annotations

from pathlib import Path

import pytest
import torch

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import check_readable, file_has_dial
from formats import rows_by_place, splat_transform
from scenes import gaussians


def stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """A program of that name on an otherwise empty path."""
    program = folder / "bin" / "splat-transform"
    program.parent.mkdir()
    asked = 'case "$*" in *--version*) echo splat-transform v3.7.0; exit;; *--list-gpus*) exit;; esac'
    program.write_text(f"#!/bin/sh\n{asked}\nfor last; do :; done\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:/usr/bin:/bin")


@pytest.mark.parametrize("name", ["a.sog", "a.KSPLAT", "a.spz"])
def test_converted_file_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    was = gaussians(5, 1, 0)
    save(tmp_path / "plain.ply", was)
    stand_in(tmp_path, monkeypatch, f'cd \'{tmp_path}\'; echo "$@" >seen; cp plain.ply "$last"')
    (tmp_path / name).write_bytes(b"NGSP, if it is an SPZ: of version 4")
    check_readable(tmp_path / name)
    assert not file_has_dial(tmp_path / name)
    found = load(tmp_path / name)
    assert torch.equal(found.gaussians.means, was.means) and "quantised" in found.notes[0]
    assert f" {tmp_path / name} " in (tmp_path / "seen").read_text()


def test_conversion_errors_name_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.sog").write_bytes(b"PK\x03\x04")
    with monkeypatch.context() as patch:
        patch.setenv("PATH", str(tmp_path))
        patch.delenv("CLOD_SPLAT_TRANSFORM", raising=False)
        for read in (check_readable, load):
            with pytest.raises(ClodError, match="a.sog: .*npm install node@22 @playcanvas/splat-transform"):
                read(tmp_path / "a.sog")
    stand_in(tmp_path, monkeypatch, 'echo "  Error: not a zip" >&2; echo "   at main" >&2; exit 1')
    with pytest.raises(ClodError, match=r"a.sog: cannot be read \(.*failed: Error: not a zip\)"):
        load(tmp_path / "a.sog")


@pytest.mark.parametrize("name", ["a.sog", "a.spz"])
def test_splat_transform_converts(tmp_path: Path, name: str) -> None:
    was = gaussians(300, 1, 0)
    save(tmp_path / "plain.ply", was)
    splat_transform("-g", "cpu", tmp_path / "plain.ply", tmp_path / name)
    means = load(tmp_path / name).gaussians.means
    assert (means[rows_by_place(was.means.numpy(), means.numpy())] - was.means).abs().max() < 1e-3
    (tmp_path / f"b{name}").write_bytes((tmp_path / name).read_bytes()[:400])
    with pytest.raises(ClodError, match=f"b{name}: cannot be read"):
        load(tmp_path / f"b{name}")
