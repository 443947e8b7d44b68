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
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
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


def arguments(doc, *, record=""):
    """A parser with the module's docstring, and with ``--record`` for a file of results."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if record:
        parser.add_argument(
            "--record", action="store_true", help=f"add the rows to results/{record}"
        )
    return parser


def capture(name):
    """The folder of a capture; exits with a message where the shared data is absent."""
    folder = SHARED / name
    if not folder.is_dir():
        sys.exit(f"{folder} is absent: set CLOD_SHARED_DATA to the folder that holds {name}")
    return folder


def checkpoint(scene):
    """``FOLDER/pretrained.ply``, or ``FOLDER/NAME.ply`` of a scene ``FOLDER/NAME``."""
    folder, _, name = scene.partition("/")
    return clod.load(capture(folder) / f"{name or 'pretrained'}.ply")


def photographs(scene):
    return clod.load_scene(capture(scene.partition("/")[0]))


def opened(scene):
    """The checkpoint and the photographs of a scene of the shared data, or of a demo's folder."""
    demo = Path(scene) / "base.ply"
    if demo.exists():
        return clod.load(demo), clod.load_scene(demo.with_name("capture"))
    return checkpoint(scene), photographs(scene)


def quality(gaussians, views, dials):
    """``clod.evaluate`` at one or more dial values, as rows of results."""
    return [row.as_dict() for row in clod.evaluate(gaussians, views, dials)]


def commit():
    """The last commit of the package that is measured, with a + where it or the benchmarks differ;
    empty without git. Commits of rows and pages do not change it.
    """
    checkout = Path(clod.__file__).parents[1]
    if not shutil.which("git") or not (checkout / ".git").exists():
        return ""

    def git(*words):
        return subprocess.run(
            ["git", *words], cwd=checkout, capture_output=True, text=True, check=True
        ).stdout.strip()

    measured = ("--", "clod_adapter", "cli")
    changed = git("status", "--porcelain", *measured, "benchmarks/*.py")
    return git("log", "-1", "--format=%h", *measured) + ("+" if changed else "")


def about():
    """Commit and machine of a row."""
    return {"commit": commit(), "machine": machine()}


def append(file, row, record=True):
    """Prints a row to stderr, and adds it to ``results/<file>`` unless ``record`` is false."""
    text = json.dumps(jsonable({**about(), "benchmark": Path(file).stem, **row}))
    print(text, file=sys.stderr, flush=True)
    if record:
        RESULTS.mkdir(exist_ok=True)
        with open(RESULTS / file, "a", encoding="utf-8") as out:
            out.write(text + "\n")


def stored(file):
    """The rows of ``results/<file>``."""
    path = RESULTS / file
    lines = path.read_text("utf-8").splitlines() if path.exists() else []
    return [json.loads(line) for line in lines]


def last(file, *names, **where):
    """The last row of each combination of these values, among the rows that have those of
    ``where``.
    """
    found = {}
    for row in stored(file):
        if all(row.get(name) == value for name, value in where.items()):
            found[tuple(row.get(name) for name in names)] = row
    return found


@dataclass
class Table:
    """A table of a page, and the rows that it is made of; columns from ``numbers_from`` on are
    aligned to the right.
    """

    heads: Sequence[str]
    lines: Iterable[Sequence[object]]
    rows: Iterable[Row]
    numbers_from: int | None = None

    def markdown(self):
        left = len(self.heads) if self.numbers_from is None else self.numbers_from
        marks = ["---"] * left + ["---:"] * (len(self.heads) - left)
        lines = [f"| {' | '.join(map(str, cells))} |" for cells in (self.heads, *self.lines)]
        lines.insert(1, f"|{'|'.join(marks)}|")
        return "\n".join(lines).replace("  ", " ")


def psnr_kept(row):
    return f"{row['psnr']:.2f} @ {100 * row['kept_share']:.0f} %"


def psnr_at(points, share):
    """PSNR of the point with this share; empty where there is none."""
    return "".join(f"{point['psnr']:.2f}" for point in points if point["share"] == share)


def percent(shares):
    return [f"{100 * share:.0f} %" for share in shares]


def by_scene(scenes, shares):
    """Heads: s = 1 and the shares of each scene."""
    heads = []
    for scene in scenes:
        heads += [f"{scene}: s = 1", *percent(shares)]
    return heads


def with_best(lines, form):
    """The lines with their labels, in which the largest number of each column is bold."""
    best = [max(filter(None, column)) for column in zip(*lines.values(), strict=True)]
    written = []
    for label, values in lines.items():
        cells = [label]
        for value, most in zip(values, best, strict=True):
            text = "" if value is None else format(value, form)
            cells.append(f"**{text}**" if value == most else text)
        written.append(cells)
    return written


def outcomes(report):
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

    def __init__(self, words, *, until=""):
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

    def now(self):
        return time.perf_counter() - self.began

    def finish(self):
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

    def cost(self):
        times = {"seconds": round(self.seconds, 3), "cpu_seconds": round(self.cpu_seconds, 3)}
        return times | {"peak_bytes": self.peak_bytes}


def report_of(out):
    """The report that the command writes beside an adapted file."""
    return json.loads(out.with_suffix(".json").read_text("utf-8"))


def clod_adapt(*words, until=""):
    """The command with these words, in a process of its own."""
    return Process([*COMMAND, *words], until=until)
