from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import blank, load, save
from clod_adapter.io.file_formats import check_readable, file_has_dial
from scenes import gaussians

REAL = shutil.which("splat-transform")


def stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """A program of that name on an otherwise empty path."""
    program = folder / "bin" / "splat-transform"
    program.parent.mkdir()
    asked = 'case "$*" in *--version*) echo splat-transform v3.7.0; exit;; *--list-gpus*) exit;; esac'
    program.write_text(f"#!/bin/sh\n{asked}\nfor last; do :; done\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:/usr/bin:/bin")


@pytest.mark.parametrize("name", ["a.sog", "a.KSPLAT", "a.spz"])
def test_reads_what_it_converts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    was = gaussians(5, 1, 0)
    save(tmp_path / "plain.ply", was, blank(5, 1))
    stand_in(tmp_path, monkeypatch, f'cd \'{tmp_path}\'; echo "$@" >seen; cp plain.ply "$last"')
    (tmp_path / name).write_bytes(b"NGSP, if it is an SPZ: of version 4")
    check_readable(tmp_path / name)
    assert not file_has_dial(tmp_path / name)
    found = load(tmp_path / name)
    assert torch.equal(found.gaussians.means, was.means) and "quantised" in found.notes[0]
    assert f" {tmp_path / name} " in (tmp_path / "seen").read_text()


def test_without_it_the_install_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.sog").write_bytes(b"PK\x03\x04")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CLOD_SPLAT_TRANSFORM", raising=False)
    for read in (check_readable, load):
        with pytest.raises(ClodError, match="a.sog: .*npm install node@22 @playcanvas/splat-transform"):
            read(tmp_path / "a.sog")


def test_what_it_cannot_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, 'echo "  Error: not a zip" >&2; echo "   at main" >&2; exit 1')
    (tmp_path / "a.sog").write_bytes(b"anything")
    with pytest.raises(ClodError, match=r"a.sog: cannot be read \(.*failed: Error: not a zip\)"):
        load(tmp_path / "a.sog")
    with pytest.raises(ClodError, match="missing.sog: cannot be read"):
        load(tmp_path / "missing.sog")
    (tmp_path / "a.sog").write_bytes(b"")
    with pytest.raises(ClodError, match="a.sog: is empty"):
        load(tmp_path / "a.sog")


@pytest.mark.skipif(REAL is None, reason="splat-transform is not installed")
@pytest.mark.parametrize("name", ["a.sog", "a.spz"])
def test_the_real_one(tmp_path: Path, name: str) -> None:
    was = gaussians(300, 1, 0)
    save(tmp_path / "plain.ply", was, blank(300, 1))
    subprocess.run([REAL, "-q", "-g", "cpu", tmp_path / "plain.ply", tmp_path / name], check=True)
    found = load(tmp_path / name).gaussians
    order, theirs = was.means[:, 0].argsort(), found.means[:, 0].argsort()
    assert (was.means[order] - found.means[theirs]).abs().max() < 1e-3
    (tmp_path / f"b{name}").write_bytes((tmp_path / name).read_bytes()[:400])
    with pytest.raises(ClodError, match=f"b{name}: cannot be read"):
        load(tmp_path / f"b{name}")
