"""Puts deliberate faults into a copy of the code, one at a time, and records which test catches
each.

    python benchmarks/faults.py --record            # all of faults/*.toml
    python benchmarks/faults.py io kernels/sign     # one file of them, one fault
    python benchmarks/faults.py --check             # whether each still applies, without a run

A fault is one replaced text in one file: ``name``, ``file``, ``before`` (occurs once), ``after``,
and ``tests``, the paths that run. The exit code is 1 where a fault was not caught, and, before any
run, where a ``before`` does not occur once.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

from common import ROOT, SHARED, append, arguments

FILE = "faults.jsonl"
LISTS = ROOT / "benchmarks" / "faults"
LEFT_OUT = shutil.ignore_patterns(
    ".venv", ".git", "*.egg-info", "demo", "build", "node_modules", "*_cache"
)


def faults(words):
    """The faults named, all without words: ``ROOM/NAME`` and the entry."""
    for path in sorted(LISTS.glob("*.toml")):
        for entry in tomllib.loads(path.read_text(encoding="utf-8"))["fault"]:
            name = f"{path.stem}/{entry['name']}"
            if not words or path.stem in words or name in words:
                yield name, entry


def misfits(words):
    """A line for each of the faults that no longer applies."""
    lines = []
    for name, entry in faults(words):
        path = ROOT / entry["file"]
        count = path.read_text(encoding="utf-8").count(entry["before"]) if path.exists() else 0
        if count != 1:
            lines.append(f"{name}: its 'before' occurs {count} times in {entry['file']}, not once")
    return lines


def first_failure(copy, tests):
    """The first test that fails in the copy, or the run's error, empty where all pass; and pytest's
    last line.
    """
    # kernels are compiled
    options = ["-x", "-q", "-p", "no:cacheprovider", "--numprocesses=0", "-o", "timeout=900"]
    words = [sys.executable, "-m", "pytest", *options, *tests]
    environment = os.environ | {"PYTHONPATH": str(copy), "CLOD_SHARED_DATA": str(SHARED)}
    done = subprocess.run(
        words, cwd=copy, env=environment, capture_output=True, text=True, check=False
    )
    lines = (done.stdout + done.stderr).splitlines() or [""]
    failed = (line.split()[1] for line in lines if line.startswith(("FAILED", "ERROR ")))
    return next(failed, lines[-1]) if done.returncode else "", lines[-1]


def run(copy, entry):
    """What catches the fault, and the counts, as by ``first_failure``."""
    path = copy / entry["file"]
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(entry["before"], entry["after"]), encoding="utf-8")
    try:
        return first_failure(copy, entry["tests"])
    finally:
        path.write_text(text, encoding="utf-8")


def main():
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("faults", nargs="*", help="ROOM or ROOM/NAME; default: all")
    parser.add_argument("--check", action="store_true", help="only check that each fault applies")
    args = parser.parse_args()
    if (wrong := misfits(args.faults)) or args.check:
        sys.exit("\n".join(wrong) or 0)
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / ROOT.name
        shutil.copytree(ROOT, copy, ignore=LEFT_OUT, symlinks=True)
        # without the link the installed one is imported
        (copy / "clod_adapter" / "cli").symlink_to(copy / "cli")
        for name, entry in faults(args.faults):
            began = time.perf_counter()
            by, counts = run(copy, entry)
            missed += not by
            print(f"{name:40} {by or f'NOT CAUGHT ({counts})'}", flush=True)
            if args.record:
                seconds = round(time.perf_counter() - began, 1)
                append(FILE, {"fault": name, "caught_by": by, "seconds": seconds})
    sys.exit(bool(missed))


if __name__ == "__main__":
    main()
