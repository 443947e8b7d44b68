"""The commands without what Windows and macOS lack; files that are open are not renamed or removed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from runs import names


def test_commands_without_posix(capture: Any, tmp_path: Path) -> None:
    adapt = [
        str(capture.ply),
        "--images",
        str(capture.scene),
        "-o",
        "dial.ply",
        "--iters",
        "4",
        "--report",
        "--quiet",
        "--accept-loss",
    ]
    commands = [
        adapt,
        [*adapt, "--resume"],
        [str(capture.ply), "-o", "placed.ply", "--iters", "2", "--quiet", "--accept-loss"],
        ["eval", "dial.ply", "--images", str(capture.scene), "--sv", "1", "2", "--quiet"],
        ["render", "dial.ply", "--images", str(capture.scene), "--sv", "1", "-o", "pictures", "--quiet"],
        ["apply", str(capture.ply), "dial.safetensors", "-o", "again.ply", "--quiet"],
        *(["export", "dial.ply", "-o", f"plain.{suffix}", "--quiet"] for suffix in ("spz", "html", "glb")),
        ["export", "dial.ply", "-o", "plain.ply", "--keep", "50", "--quiet"],
    ]
    program = Path(__file__).with_name("without_posix.py")
    words = [sys.executable, str(program), json.dumps(commands)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {"dial.ply", "dial.html", "placed.ply", "pictures", "plain.spz"} <= set(names(tmp_path))
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
