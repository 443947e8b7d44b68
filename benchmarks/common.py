"""Options, captures, rows of results, tables, and timed processes of the benchmarks."""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as xml
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import clod_adapter as clod
from clod_adapter._support.machine import machine
from clod_adapter.cli.shared.outputs import jsonable

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
CACHE = ROOT / "benchmarks" / "cache"
SHARED = Path(os.environ.get("CLOD_SHARED_DATA", ROOT.parent / "shared" / "data"))
COMMAND = (sys.executable, "-m", "clod_adapter.cli.main")
Row = dict[str, Any]


class _Call(argparse.Action):
    """Calls ``const`` and exits, as ``--help`` does."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        self.const()
        parser.exit()


def arguments(
    doc: str | None, *, table: Callable[[], None] | None = None, record: str = ""
) -> argparse.ArgumentParser:
    """A parser with the module's docstring; with ``--table``, and with ``--record`` for a file of
    results.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if table:
        help_ = "print the stored rows as a Markdown table, run nothing"
        parser.add_argument("--table", action=_Call, nargs=0, const=table, help=help_)
    if record:
        parser.add_argument(
            "--record", action="store_true", help=f"add the rows to results/{record}"
        )
    return parser


def capture(name: str) -> Path:
    """The folder of a capture; exits with a message where the shared data is absent."""
    folder = SHARED / name
    if not folder.is_dir():
        sys.exit(f"{folder} is absent: set CLOD_SHARED_DATA to the folder that holds {name}")
    return folder


def checkpoint(scene: str) -> clod.Checkpoint:
    """``FOLDER/pretrained.ply``, or ``FOLDER/NAME.ply`` of a scene ``FOLDER/NAME``."""
    folder, _, name = scene.partition("/")
    return clod.load(capture(folder) / f"{name or 'pretrained'}.ply")


def photographs(scene: str) -> clod.Scene:
    return clod.load_scene(capture(scene.partition("/")[0]))


def quality(gaussians: clod.Gaussians, views: Sequence[clod.View], dials: Any) -> list[Row]:
    """``clod.evaluate`` at one or more dial values, as rows of results."""
    return [row.as_dict() for row in clod.evaluate(gaussians, views, dials)]


def commit() -> str:
    """The commit of the package that is measured, with a + where it or the benchmarks differ; empty
    without git.
    """
    checkout = Path(clod.__file__).parents[1]
    if not shutil.which("git") or not (checkout / ".git").exists():
        return ""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=checkout, capture_output=True, text=True, check=True
        ).stdout.strip()

    changed = git("status", "--porcelain", "--", "clod_adapter", "cli", "benchmarks/*.py")
    return git("rev-parse", "--short", "HEAD") + ("+" if changed else "")


def about() -> Row:
    """Commit and machine of a row."""
    return {"commit": commit(), "machine": machine()}


def append(file: str, row: Row) -> None:
    """Adds a row to ``results/<file>`` and prints it to stderr."""
    text = json.dumps(jsonable({**about(), **row}))
    RESULTS.mkdir(exist_ok=True)
    with open(RESULTS / file, "a", encoding="utf-8") as out:
        out.write(text + "\n")
    print(text, file=sys.stderr, flush=True)


def stored(file: str) -> list[Row]:
    """The rows of ``results/<file>``."""
    path = RESULTS / file
    lines = path.read_text("utf-8").splitlines() if path.exists() else []
    return [json.loads(line) for line in lines]


def table(
    heads: Sequence[str], rows: Iterable[Sequence[object]], numbers_from: int | None = None
) -> str:
    """A Markdown table; columns from ``numbers_from`` on are aligned to the right."""
    left = len(heads) if numbers_from is None else numbers_from
    marks = ["---"] * left + ["---:"] * (len(heads) - left)
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], f"|{'|'.join(marks)}|", *lines[1:]])


def outcomes(report: Path) -> Row:
    """Counts of a JUnit report, and the names of the tests that failed."""
    root = xml.parse(report).getroot()
    bad = {*root.iterfind(".//testcase[failure]"), *root.iterfind(".//testcase[error]")}
    skipped = len(root.findall(".//testcase[skipped]"))
    names = sorted({f"{case.get('classname')}::{case.get('name')}" for case in bad})
    return {
        "passed": len(root.findall(".//testcase")) - len(bad) - skipped,
        "failed": len(bad),
        "skipped": skipped,
        "failures": names,
    }


class Process:
    """A command in a process of its own: its output, time and memory.

    Attributes:
        out: stdout.
        line: the line of stdout that has the text ``until``.
        seconds, cpu_seconds, peak_bytes: of the whole process, after ``finish``.
    """

    def __init__(self, words: Iterable[object], *, until: str = "") -> None:
        """Runs to the end, or with ``until`` to a line on stdout that has this text."""
        self.words = [str(word) for word in words]
        self.errors = tempfile.TemporaryFile("w+")  # noqa: SIM115, until it is collected
        self.began = time.perf_counter()
        self.process = subprocess.Popen(
            self.words,
            text=True,
            cwd=tempfile.gettempdir(),
            stdout=subprocess.PIPE,
            stderr=self.errors,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
        self.out = ""
        self.line = ""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.out += line
            if until and until in line:
                self.line = line
                return
        self.finish()

    def now(self) -> float:
        return time.perf_counter() - self.began

    def finish(self) -> None:
        """Waits for the end; exits where the process failed."""
        _, status, usage = os.wait4(self.process.pid, 0)
        self.seconds = self.now()
        self.cpu_seconds = usage.ru_utime + usage.ru_stime
        self.peak_bytes = usage.ru_maxrss * 1024
        self.process.returncode = os.waitstatus_to_exitcode(status)
        if self.process.returncode:
            self.errors.seek(0)
            said = self.errors.read().rstrip()
            sys.exit(f"exit code {self.process.returncode}: {' '.join(self.words)}\n{said}")

    def cost(self) -> Row:
        times = {"seconds": round(self.seconds, 3), "cpu_seconds": round(self.cpu_seconds, 3)}
        return times | {"peak_bytes": self.peak_bytes}


def report_of(out: Path) -> Row:
    """The report that the command writes beside an adapted file."""
    return json.loads(out.with_suffix(".json").read_text("utf-8"))


def clod_adapt(*words: object, until: str = "") -> Process:
    """The command with these words, in a process of its own."""
    return Process([*COMMAND, *words], until=until)
