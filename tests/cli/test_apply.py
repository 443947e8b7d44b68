"""``clod-adapt apply``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

TINY = ("--iters", 3, "--quiet", "--out", "dial.ply")


def test_apply_gives_the_same_file(clod: Any, capture: Any, tmp_path: Path) -> None:
    clod(capture.ply, "--images", capture.scene, *TINY)
    done = clod("apply", capture.ply, "dial.safetensors", "-o", "again.ply", "--json")
    assert done.code == 0 and (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    assert json.loads(done.out)["outputs"] == {"ply": "again.ply"}


def test_apply_refuses_another_base(clod: Any, capture: Any, tmp_path: Path) -> None:
    clod(capture.ply, "--images", capture.scene, *TINY)
    other = capture.write(tmp_path / "other.ply", capture.gaussians.replace(sh0=capture.gaussians.sh0 + 1e-3))
    done = clod("apply", other, "dial.safetensors", "-o", "again.ply")
    assert (done.code, done.out) == (2, "") and f"clod-adapt: error: {other}: a different base" in done.err, done
    assert not (tmp_path / "again.ply").exists()
