"""From the command line to the first training step: how long, in which phases, and how much memory.

    python benchmarks/startup.py                         # everything, on plush_half; several minutes
    python benchmarks/startup.py warm help --repeats 5   # two cases of it
    python benchmarks/startup.py --record                # and a row in results/startup.jsonl

The command itself is run, ``clod-adapt PLY --images DIR --iters 1``, and timed from outside: by the moments at which it
says what it has done, and by the seconds in its report. The cases:

- ``help``: ``--help``, and an error: a checkpoint that does not exist;
- ``warm``: with kernels cached by an earlier run, the median of the repeats;
- ``first``: with an empty cache, where kernels are compiled;
- ``together``: several processes that start at once with an empty cache must all write the same files;
- ``readonly``: the package where it cannot be written, then no writable home either (on ci_banana: no times);
- ``memory``: the peak of a longer training, beyond that of a process that only imports torch.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Thread
from typing import Any

from common import ROOT, append, capture

FILE = "startup.jsonl"
CASES = ("help", "warm", "first", "together", "readonly", "memory")
COMMAND = (sys.executable, "-m", "clod_adapter.cli.main")
MEMORY_STEPS = 100
# What the command says on stderr once a phase is over.
SAID = {
    "checkpoint": r": [\d,]+ Gaussians, SH",
    "photographs": r": \d+ photographs to train on",
    "base": r"^base: ",
    "trained": r"^trained ",
}
PHASES = ("imports", "reading", "kernels", "base", "importance", "first_step", "to_first_step")


class Run:
    """A process, the moments at which it said things, and what it cost."""

    def __init__(self, words: Sequence[object], environment: dict[str, str]) -> None:
        self.began = time.perf_counter()
        self.process = subprocess.Popen(
            [str(word) for word in words], env=os.environ | environment, text=True,
            cwd=tempfile.gettempdir(),  # not the checkout, whose package python -m would take
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        self.lines: list[str] = []
        self.moments: dict[str, float] = {}
        self.cpu: dict[str, float] = {}
        self.reader = Thread(target=self._follow)
        self.reader.start()

    def _follow(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line.rstrip())
            for name, pattern in SAID.items():
                if name not in self.moments and re.search(pattern, line):
                    self.moments[name] = time.perf_counter() - self.began
                    self.cpu[name] = cpu_seconds(self.process.pid)

    def finish(self, code: int = 0) -> str:
        """Waits for it to end with this exit code; returns its stdout."""
        assert self.process.stdout is not None
        out = self.process.stdout.read()
        self.reader.join()
        _, status, usage = os.wait4(self.process.pid, 0)
        self.process.returncode = os.waitstatus_to_exitcode(status)
        self.seconds = time.perf_counter() - self.began
        self.cpu_seconds = usage.ru_utime + usage.ru_stime
        self.peak_bytes = usage.ru_maxrss * 1024
        if self.process.returncode != code:
            sys.exit("\n".join([f"exit code {self.process.returncode}: {self.process.args}", *self.lines]))
        return out

    def said(self, text: str) -> list[str]:
        return [line for line in self.lines if text in line]


def cpu_seconds(pid: int) -> float:
    """What a running process has used so far, in all its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def adapt_words(scene: str, out: Path, iters: int = 1) -> list[object]:
    folder = capture(scene)
    ply = folder / "pretrained.ply"
    return [*COMMAND, ply, "--images", folder, "--iters", iters, "--out", out / "dial.ply", "--json"]


def adapt(scene: str, out: Path, cache: Path) -> tuple[Run, dict[str, float]]:
    """One run of one step, and its phases in seconds of wall time."""
    run = Run(adapt_words(scene, out), {"NUMBA_CACHE_DIR": str(cache)})
    seconds, at = json.loads(run.finish())["seconds"], run.moments
    kernels = seconds.get("kernels", 0.0)
    durations = (
        at["photographs"] - seconds["load"], seconds["load"], kernels, at["base"] - at["photographs"] - kernels,
        seconds["start"], seconds["train"], at["trained"],
    )  # fmt: skip
    return run, dict(zip(PHASES, durations, strict=True))


def case_help(scene: str, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    row = {}
    for name, words, code in (("help", ["--help"], 0), ("error", ["missing.ply", "--images", capture(scene)], 2)):
        runs = []
        for _ in range(args.repeats):
            runs.append(Run([*COMMAND, *words], {}))
            runs[-1].finish(code)
        row[f"{name}_seconds"] = round(statistics.median(run.seconds for run in runs), 3)
        row[f"{name}_cpu_seconds"] = round(statistics.median(run.cpu_seconds for run in runs), 3)
    return row


def case_warm(scene: str, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    adapt(scene, work, work / "cache")
    runs = [adapt(scene, work, work / "cache") for _ in range(args.repeats)]
    assert not any(run.said("compiling") for run, _ in runs)
    phases = {name: round(statistics.median(times[name] for _, times in runs), 2) for name in PHASES}
    cpu = statistics.median(run.cpu["trained"] for run, _ in runs)
    return {"phases": phases, "cpu_to_first_step": round(cpu, 2), "repeats": args.repeats}


def case_first(scene: str, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    run, phases = adapt(scene, work, work / "empty")
    assert run.said("compiling kernels (first run only")
    rounded = {name: round(value, 2) for name, value in phases.items()}
    return {"phases": rounded, "cpu_to_first_step": round(run.cpu["trained"], 2)}


def case_together(scene: str, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    folders = [work / f"together{i}" for i in range(args.processes + 1)]
    for folder in folders:
        folder.mkdir()
    environment = {"NUMBA_CACHE_DIR": str(work / "shared")}
    runs = [Run(adapt_words(scene, folder), environment) for folder in folders[1:]]
    for run in runs:
        run.finish()
    alone = Run(adapt_words(scene, folders[0]), environment)  # from what they left
    alone.finish()
    assert not alone.said("compiling"), "the cache is not complete"
    written = {tuple((folder / name).read_bytes() for name in ("dial.ply", "dial.safetensors")) for folder in folders}
    assert len(written) == 1, "the files differ"
    return {"processes": args.processes, "seconds": round(max(run.seconds for run in runs), 1)}


def case_readonly(scene: str, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    """The package without its caches in a folder that cannot be written."""
    site, home = work / "site", work / "home"
    leave = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")
    shutil.copytree(ROOT / "clod_adapter", site / "clod_adapter", ignore=leave)
    shutil.copytree(ROOT / "cli", site / "clod_adapter" / "cli", ignore=leave)
    home.mkdir()
    environment = {
        "PYTHONPATH": str(site),
        "HOME": str(home),
        "XDG_CACHE_HOME": str(home / ".cache"),
        "NUMBA_CACHE_DIR": "",
    }
    words = [*as_somebody(), *adapt_words("ci_banana", work)]
    row: dict[str, Any] = {}
    folders = [site, *(path for path in site.rglob("*") if path.is_dir())]
    try:
        for folder in folders:
            folder.chmod(0o555)
        for name in ("first", "second", "no_home"):
            if name == "no_home":
                shutil.rmtree(home)
                home.touch()
            run = Run(words, environment)
            run.finish()
            row[name] = run.said("kernels")
        assert not list(site.rglob("__pycache__"))
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert "first run only" in row["first"][0] and row["second"] == [] and len(row["no_home"]) > 0, row
    return row


def as_somebody() -> list[str]:
    """For root: a prefix that takes its right to write everywhere."""
    if os.geteuid() != 0:
        return []
    rights = "-dac_override,-dac_read_search,-fowner"
    return ["setpriv", f"--bounding-set={rights}", f"--inh-caps={rights}", "--"]


def case_memory(scene: str, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    empty = Run([sys.executable, "-c", "import torch"], {})
    empty.finish()
    row: dict[str, Any] = {"torch_bytes": empty.peak_bytes, "steps": MEMORY_STEPS}
    for name in ("compiling", "cached"):
        run = Run(adapt_words(scene, work, MEMORY_STEPS), {"NUMBA_CACHE_DIR": str(work / "memory")})
        run.finish()
        row[f"{name}_bytes"] = run.peak_bytes - empty.peak_bytes
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", choices=[[], *CASES], help="default: all of them")
    parser.add_argument("--scene", default="plush_half")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--processes", type=int, default=2, help="that start at once")
    parser.add_argument("--record", action="store_true", help=f"add a row to results/{FILE}")
    args = parser.parse_args()
    row: dict[str, Any] = {"benchmark": "startup", "scene": args.scene, "load": round(os.getloadavg()[0], 2)}
    for case in args.cases or CASES:
        with tempfile.TemporaryDirectory() as work:
            row[case] = globals()[f"case_{case}"](args.scene, Path(work), args)
        print(f"{case:9} {json.dumps(row[case])}", flush=True)
    if args.record:
        append(FILE, row)


if __name__ == "__main__":
    main()
