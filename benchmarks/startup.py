"""Seconds from the command to the first training step, by phase.

    python benchmarks/startup.py --record                # on plush_half; several minutes

Times the command ``clod-adapt PLY --images DIR --iters 1`` from outside, by its messages and its report:

- ``help``: ``--help``, and the error for a checkpoint that does not exist;
- ``warm``: with cached kernels, the median of three runs;
- ``first``: with an empty cache, where kernels are compiled.
"""

from __future__ import annotations

import json
import os
import statistics
import tempfile
from pathlib import Path

from common import COMMAND, Process, Row, append, arguments, capture

FILE = "startup.jsonl"
SCENE, REPEATS = "plush_half", 3
# Messages of the command on stderr at the end of a phase.
SAID = {
    "checkpoint": r": [\d,]+ Gaussians, SH", "photographs": r": \d+ photographs to train on", "base": r"^base: ",
    "trained": r"^trained ",
}  # fmt: skip
PHASES = ("imports", "reading", "kernels", "base", "importance", "first_step", "to_first_step")


def adapt(out: Path, cache: Path) -> tuple[Process, dict[str, float]]:
    """One run of one step, and its phases in seconds of wall time."""
    folder = capture(SCENE)
    words = [folder / "pretrained.ply", "--images", folder, "--iters", 1, "--out", out / "dial.ply", "--json"]
    run = Process([*COMMAND, *words], SAID, environment={"NUMBA_CACHE_DIR": str(cache)})
    seconds, at = json.loads(run.out)["seconds"], run.moments
    kernels = seconds.get("kernels", 0.0)
    durations = (
        at["photographs"] - seconds["load"], seconds["load"], kernels, at["base"] - at["photographs"] - kernels,
        seconds["start"], seconds["train"], at["trained"],
    )  # fmt: skip
    return run, dict(zip(PHASES, durations, strict=True))


def compiles(run: Process) -> bool:
    return any("compiling kernels (first run only" in line for line in run.lines)


def case_help(work: Path) -> Row:
    row = {}
    for name, words, code in (("help", ["--help"], 0), ("error", ["missing.ply", "--images", capture(SCENE)], 2)):
        runs = [Process([*COMMAND, *words], code=code) for _ in range(REPEATS)]
        row[f"{name}_seconds"] = round(statistics.median(run.seconds for run in runs), 3)
        row[f"{name}_cpu_seconds"] = round(statistics.median(run.cpu_seconds for run in runs), 3)
    return row


def case_warm(work: Path) -> Row:
    adapt(work, work / "cache")
    runs = [adapt(work, work / "cache") for _ in range(REPEATS)]
    assert not any(compiles(run) for run, _ in runs)
    phases = {name: round(statistics.median(times[name] for _, times in runs), 2) for name in PHASES}
    cpu = statistics.median(run.cpu["trained"] for run, _ in runs)
    return {"phases": phases, "cpu_to_first_step": round(cpu, 2), "repeats": REPEATS}


def case_first(work: Path) -> Row:
    run, phases = adapt(work, work / "empty")
    assert compiles(run)
    rounded = {name: round(value, 2) for name, value in phases.items()}
    return {"phases": rounded, "cpu_to_first_step": round(run.cpu["trained"], 2)}


CASES = {"help": case_help, "warm": case_warm, "first": case_first}


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("cases", nargs="*", choices=[[], *CASES], help="default: all of them")
    args = parser.parse_args()
    row: Row = {"benchmark": "startup", "scene": SCENE, "load": round(os.getloadavg()[0], 2)}
    for case in args.cases or CASES:
        with tempfile.TemporaryDirectory() as work:
            row[case] = CASES[case](Path(work))
        print(f"{case:9} {json.dumps(row[case])}", flush=True)
    if args.record:
        append(FILE, row)


if __name__ == "__main__":
    main()
