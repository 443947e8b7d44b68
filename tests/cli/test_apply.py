"""``clod-adapt apply``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest


def test_apply(clod: Any, capture: Any, dialled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The base of the adapter gives the adapted file, also with another version; any other base is refused."""
    adapter = dialled.with_suffix(".safetensors")
    monkeypatch.setattr("importlib.metadata.version", lambda name: "99.0")
    assert clod("--version").out == "clod-adapt 99.0\n"
    done = clod("apply", capture.ply, adapter, "-o", "again.ply", "--json")
    assert done.code == 0 and (tmp_path / "again.ply").read_bytes() == dialled.read_bytes()
    assert json.loads(done.out)["outputs"] == {"ply": "again.ply"}
    assert "300 Gaussians with sigma_d and growth_d" in clod("apply", capture.ply, adapter, "-o", "again.ply").out
    other = capture.write(tmp_path / "other.ply", capture.gaussians.replace(sh0=capture.gaussians.sh0 + 1e-3))
    done = clod("apply", other, adapter, "-o", "third.ply")
    assert (done.code, done.out) == (2, "") and f"clod-adapt: error: {other}: a different base" in done.err, done
    assert not (tmp_path / "third.ply").exists()
