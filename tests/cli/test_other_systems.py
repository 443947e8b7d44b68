"""The commands without what Windows and macOS lack; files that are open are not renamed or removed."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from runs import names

COMMANDS = """
base.ply --images scene -o dial.ply --iters 2 --accept-loss
render dial.ply --images scene --sv 1 -o pictures
apply base.ply dial.safetensors -o again.ply
export dial.ply -o plain.spz
export dial.ply -o plain.html
"""


def test_commands_without_posix(capture: Any, tmp_path: Path) -> None:
    paths = {"base.ply": str(capture.ply), "scene": str(capture.scene)}
    commands = [[*(paths.get(w, w) for w in line.split()), "--quiet"] for line in COMMANDS.strip().splitlines()]
    program = Path(__file__).with_name("without_posix.py")
    words = [sys.executable, str(program), json.dumps(commands)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {"dial.ply", "dial.json", "pictures", "plain.spz", "plain.html"} <= set(names(tmp_path))
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
