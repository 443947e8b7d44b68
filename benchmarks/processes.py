"""Adapting in two processes against one.

    python benchmarks/processes.py plush_half         # 300 views

Runs the command with one view a step, with two, and with two processes of one view each, and
compares the last two files. Rows go to ``results/processes.jsonl``.
"""

import json
import sys
import tempfile
from pathlib import Path

import clod_adapter as clod
from common import COMMAND, Process, append, arguments, capture

FILE = "processes.jsonl"


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="+")
    for scene in parser.parse_args().scenes:
        run(scene)


def run(name: str) -> None:
    torchrun = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        2,
        "-m",
    ]
    runs = {
        "one view": (COMMAND, {"iters": 300, "batch": 1}),
        "two views": (COMMAND, {"iters": 150, "batch": 2}),
        "two processes": ((*torchrun, "clod_adapter"), {"iters": 150, "batch": 2}),
    }
    with tempfile.TemporaryDirectory() as folder:
        found, files = {}, []
        for label, (command, options) in runs.items():
            out = Path(folder) / f"{label}.ply".replace(" ", "_")
            words = [
                capture(name) / "pretrained.ply",
                "--images",
                capture(name),
                "--out",
                out,
                "--quiet",
            ]
            run = Process(
                [*command, *words, *(w for k, v in options.items() for w in (f"--{k}", v))]
            )
            report = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
            found[label] = options | run.cost() | {"rows": report["rows"]}
            files.append(clod.load(out).gaussians)
        append(
            FILE, {"what": "processes", "scene": name, "runs": found, "alike": files[1] == files[2]}
        )


if __name__ == "__main__":
    main()
