"""What the benchmarks share: the captures beside the checkout, and rows that say where they come from."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import clod_adapter
from clod_adapter.cli.shared.report import jsonable, machine

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
SHARED = Path(os.environ.get("CLOD_SHARED_DATA", ROOT.parent / "shared" / "data"))


def capture(name: str) -> Path:
    """The folder of a capture; leaves with a message where the shared data is absent."""
    folder = SHARED / name
    if not folder.is_dir():
        sys.exit(f"{folder} is absent: set CLOD_SHARED_DATA to the folder that holds {name}")
    return folder


def commit() -> str:
    """The commit of the package that is measured, with a + where it or the benchmarks differ from it."""
    checkout = Path(clod_adapter.__file__).parents[1]

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=checkout, capture_output=True, text=True, check=True
        ).stdout.strip()

    changed = git("status", "--porcelain", "--", "clod_adapter", "cli", "benchmarks/*.py")
    return git("rev-parse", "--short", "HEAD") + ("+" if changed else "")


def append(file: str, row: dict[str, Any]) -> None:
    """Adds a row to ``results/<file>`` and prints it to stderr."""
    full = jsonable({"commit": commit(), "machine": machine(), **row})
    RESULTS.mkdir(exist_ok=True)
    with open(RESULTS / file, "a", encoding="utf-8") as out:
        out.write(json.dumps(full) + "\n")
    print(json.dumps(full), file=sys.stderr, flush=True)
