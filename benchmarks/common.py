"""Shared by the benchmarks: options, captures, rows of results, tables, and processes that are
timed from outside.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as xml
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from threading import Thread
from typing import Any

import clod_adapter as clod
from clod_adapter._support.machine import machine
from clod_adapter.cli.shared.outputs import jsonable

import torch

ROOT = Path(__file__).resolve().parents[1]
RESULTS, CACHE = ROOT / "benchmarks" / "results", ROOT / "benchmarks" / "cache"
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
    return (
        [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if path.exists()
        else []
    )


def table(
    heads: Sequence[str], rows: Iterable[Sequence[object]], numbers_from: int | None = None
) -> str:
    """A Markdown table; columns from ``numbers_from`` on are aligned to the right."""
    marks = [
        "---:" if numbers_from is not None and k >= numbers_from else "---"
        for k in range(len(heads))
    ]
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], f"|{'|'.join(marks)}|", *lines[1:]])


def falling(values: Any) -> Any:
    """``[N]`` rows by falling value, equal ones in their order."""
    return values.argsort(descending=True, stable=True)


def head(gaussians: clod.Gaussians, count: int) -> clod.Gaussians:
    """The first ``count`` rows."""
    return gaussians.select(torch.arange(count))


def outcomes(report: Path) -> Row:
    """Counts of a JUnit report, and the names of the tests that failed."""
    cases = list(xml.parse(report).getroot().iter("testcase"))
    bad = [case for case in cases if any(case.findall(kind) for kind in ("failure", "error"))]
    skipped = sum(case.find("skipped") is not None for case in cases)
    names = sorted({f"{case.get('classname')}::{case.get('name')}" for case in bad})
    return {
        "passed": len(cases) - len(bad) - skipped,
        "failed": len(bad),
        "skipped": skipped,
        "failures": names,
    }


class Process:
    """A command in a process of its own: its output, the times of its messages, its memory over
    time, its cost.

    Attributes:
        out, lines: stdout; the lines of stderr.
        moments, cpu: wall and CPU seconds up to the first line on stderr that matches each pattern
            of ``messages``.
        memory: (seconds, resident bytes, CPU seconds) every 20 ms.
        seconds, cpu_seconds, peak_bytes: of the whole process, after ``finish``.
    """

    def __init__(
        self,
        words: Iterable[object],
        messages: Mapping[str, str] | None = None,
        *,
        until: str = "",
        environment: Mapping[str, str] | None = None,
        code: int = 0,
    ) -> None:
        """Runs to the end, or with ``until`` to a line on stdout that has this text: ``line``.
        ``code``: exit code.
        """
        self.words, self.messages, self.code = [str(word) for word in words], messages or {}, code
        self.began = time.perf_counter()
        self.process = subprocess.Popen(
            self.words,
            text=True,
            cwd=tempfile.gettempdir(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": str(ROOT)} | dict(environment or {}),
        )
        self.out = ""
        self.line = ""
        self.lines = list[str]()
        self.ended = False
        self.moments, self.cpu, self.memory = (
            dict[str, float](),
            dict[str, float](),
            list[tuple[float, int, float]](),
        )
        self.threads = [Thread(target=each, daemon=True) for each in (self._follow, self._sample)]
        for thread in self.threads:
            thread.start()
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.out += line
            if until and until in line:
                self.line = line
                return
        self.finish()

    def now(self) -> float:
        return time.perf_counter() - self.began

    def _follow(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line.rstrip())
            for name, pattern in self.messages.items():
                if name not in self.moments and re.search(pattern, line):
                    self.moments[name], self.cpu[name] = self.now(), self._used()[1]

    def _used(self) -> tuple[int, float]:
        """Resident bytes, and CPU seconds of all threads so far."""
        statm, stat = (
            Path(f"/proc/{self.process.pid}/{name}").read_text("utf-8")
            for name in ("statm", "stat")
        )
        fields = stat.rpartition(")")[2].split()
        cpu = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        return int(statm.split()[1]) * os.sysconf("SC_PAGE_SIZE"), cpu

    def _sample(self) -> None:
        while not self.ended:
            try:
                self.memory.append((self.now(), *self._used()))
            except (OSError, IndexError):
                return
            time.sleep(0.02)

    def finish(self) -> None:
        """Waits for the end; exits where the process ended with another code."""
        self.threads[0].join()  # it reads /proc of the process, which must not be reaped before
        _, status, usage = os.wait4(self.process.pid, 0)
        self.seconds, self.ended = self.now(), True
        self.process.returncode = os.waitstatus_to_exitcode(status)
        self.threads[1].join()
        self.cpu_seconds, self.peak_bytes = usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024
        if self.process.returncode != self.code:
            sys.exit(
                "\n".join(
                    [f"exit code {self.process.returncode}: {' '.join(self.words)}", *self.lines]
                )
            )

    def cost(self) -> Row:
        times = {"seconds": round(self.seconds, 3), "cpu_seconds": round(self.cpu_seconds, 3)}
        return times | {"peak_bytes": self.peak_bytes}
