"""Adapting in two processes against one.

    python benchmarks/processes.py plush_half         # 300 views

Runs the command with one view a step, with two, and with two processes of one view each, and
compares the last two files. Rows go to ``results/processes.jsonl``.
"""

import sys
import tempfile
from pathlib import Path

import clod_adapter as clod
from common import COMMAND, Process, append, arguments, capture, report_of

FILE = "processes.jsonl"


def main():
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="+")
    for scene in parser.parse_args().scenes:
        run(scene)


def run(name):
    torchrun = "-m torch.distributed.run --standalone --nproc-per-node 2 -m clod_adapter"
    runs = {
        "one view": (COMMAND, {"iters": 300, "batch": 1}),
        "two views": (COMMAND, {"iters": 150, "batch": 2}),
        "two processes": ((sys.executable, *torchrun.split()), {"iters": 150, "batch": 2}),
    }
    base = capture(name) / "pretrained.ply"
    with tempfile.TemporaryDirectory() as folder:
        rows, files = {}, []
        for label, (command, settings) in runs.items():
            out = Path(folder) / f"{label}.ply".replace(" ", "_")
            words = [base, "--images", capture(name), "--out", out, "--quiet"]
            for option, value in settings.items():
                words += [f"--{option}", value]
            run = Process([*command, *words])
            report = report_of(out)
            rows[label] = settings | run.cost() | {"rows": report["rows"]}
            files.append(clod.load(out).gaussians)
    alike = files[1] == files[2]
    append(FILE, {"what": "processes", "scene": name, "runs": rows, "alike": alike})


if __name__ == "__main__":
    main()
