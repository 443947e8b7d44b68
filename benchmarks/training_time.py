"""Quality against the seconds of the whole command, without options, for several numbers of steps; before and after.

    python benchmarks/training_time.py plush_half bonsai146 --iters 400 --record
    python benchmarks/training_time.py --before PYTHON --record    # another version too, installed for that interpreter
    python benchmarks/training_time.py --plot                        # docs/images/training_time.png and the table

``clod-adapt FILE --images DIR --max-sv 7`` runs as a user runs it, on two threads, with its default number of steps and
with those of ``--iters``. ``psnr`` is of the held-out photographs at the dial values of ``DIALS``.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from statistics import fmean

from clod_adapter.report.style import new_figure, save_figure
from common import COMMAND, ROOT, Process, Row, append, arguments, capture, fill_in, stored, table

FILE, PICTURE = "training_time.jsonl", ROOT / "docs" / "images" / "training_time.png"
DIALS = (1.0, 2.0, 3.0, 5.0, 7.0)
THREADS = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"}


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("scenes", nargs="*", default=["plush_half", "bonsai146"])
    parser.add_argument("--iters", nargs="*", type=int, default=[400], help="besides the default")
    parser.add_argument("--before", help="the Python of an environment with another version, which is measured too")
    parser.add_argument("--plot", action="store_true", help="draw the stored rows, run nothing")
    args = parser.parse_args()
    if args.plot:
        plot()
        return
    for scene in args.scenes:
        for iters in (*args.iters, None):
            for python in filter(None, (args.before, sys.executable)):
                row = run(scene, iters, python)
                print(json.dumps(row), flush=True)
                if args.record:
                    append(FILE, row)


def run(scene: str, iters: int | None, python: str) -> Row:
    """Times of one command, and PSNR and kept share at DIALS; of the version that ``python`` imports."""
    folder = capture(scene)
    with tempfile.TemporaryDirectory() as made:
        words = [folder / "pretrained.ply", "--images", folder, "--max-sv", 7, "-o", Path(made) / "model.ply", "--json"]
        steps = [] if iters is None else ["--iters", iters]
        process = Process([python, *COMMAND[1:], *words, *steps], environment=THREADS | {"PYTHONPATH": ""})
    report = json.loads(process.out)
    rows = {row["virtual_scale"]: row for row in report["rows"]}
    found = Process([python, "-c", "import clod_adapter as c; print(c.__path__[0])"], environment={"PYTHONPATH": ""})
    measured = Process(["git", "-C", Path(found.out.strip()).parent, "rev-parse", "--short", "HEAD"]).out.strip()
    return {
        "benchmark": "training_time", "scene": scene, "measured": measured,
        "before": python != sys.executable, "default": iters is None, "steps": report["steps"], **process.cost(),
        "parts": report["seconds"], "psnr": [rows[s]["psnr"] for s in DIALS],
        "kept": [rows[s]["kept_share"] for s in DIALS],
    }  # fmt: skip


def latest() -> list[Row]:
    """The last row of each run of the last two versions, by scene, that before first, by steps."""
    found = stored(FILE)
    versions = {(row["scene"], row["before"]): row["measured"] for row in found if row["default"]}
    own = [row for row in found if row["measured"] == versions[row["scene"], row["before"]]]
    rows = {(row["scene"], not row["before"], row["steps"]): row for row in own}
    return [rows[key] for key in sorted(rows)]


def plot() -> None:
    """A panel a scene: mean PSNR over the dial against seconds; and the table of docs/method.md."""
    rows = latest()
    scenes = sorted({row["scene"] for row in rows}, reverse=True)
    with new_figure((4.6 * len(scenes), 3.6), layout="constrained") as figure:
        for scene, axes in zip(scenes, figure.subplots(1, len(scenes), squeeze=False)[0], strict=True):
            for before, label in ((True, "1,600 steps by default"), (False, "now")):
                line = [row for row in rows if (row["scene"], row["before"]) == (scene, before)]
                axes.plot([row["seconds"] for row in line], [fmean(row["psnr"]) for row in line], "o-", label=label)
            axes.set_title(scene, loc="left", fontsize=10, weight="bold")
            axes.set_xlabel("seconds, all told")
            axes.set_ylabel("mean PSNR at s = 1, 2, 3, 5, 7, dB")
            axes.set_xlim(left=0)
            axes.legend(frameon=False, fontsize=8, loc="lower right")
        save_figure(figure, PICTURE)
    heads = ("scene", "", "steps", "seconds", "training", "CPU seconds", *(f"s = {s:g}" for s in DIALS), "mean")
    cells = [
        [
            row["scene"], "before" if row["before"] else "now", f"{row['steps']:,}", f"{row['seconds']:.0f}",
            f"{row['parts']['train']:.0f}", f"{row['cpu_seconds']:.0f}",
            *(f"{psnr:.2f}" for psnr in row["psnr"]), f"{fmean(row['psnr']):.2f}",
        ]
        for row in rows
    ]  # fmt: skip
    fill_in(ROOT / "docs" / "method.md", "training time", table(heads, cells, 2))


if __name__ == "__main__":
    main()
