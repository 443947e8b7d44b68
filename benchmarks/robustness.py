"""The paper's robustness experiment: two checkpoints of one scene at four ranges of the dial.

    python benchmarks/robustness.py

Runs ``clod-adapt robustness`` at its defaults and keeps its rows as ``results/robustness.csv`` and
``results/robustness.json``.
"""

import json
import shutil
import tempfile
from pathlib import Path

from common import RESULTS, Table, about, arguments, capture, clod_adapt, psnr_kept

SCENE, FILE = "plush_half", RESULTS / "robustness.json"
CHECKPOINTS = ("pretrained", "pretrained_mask")
RANGES = (1, 3, 5, 7)


def main():
    arguments(__doc__).parse_args()
    folder = capture(SCENE)
    bases = [folder / f"{name}.ply" for name in CHECKPOINTS]
    with tempfile.TemporaryDirectory() as place:
        words = ("--images", folder, "--max-sv", *RANGES, "--out", place)
        clod_adapt("robustness", *bases, *words)
        report = Path(place) / FILE.name
        text = report.read_text("utf-8").replace(str(folder), SCENE).replace(f"{place}/", "")
        row = json.loads(text) | about()
        shutil.copy(report.with_suffix(".csv"), RESULTS)
    FILE.write_text(json.dumps(row), encoding="utf-8")


def row():
    return json.loads(FILE.read_text("utf-8"))


def page_table():
    """The dial by the range that was trained; beyond it in italics."""
    stored = row()
    lines = [[f"s = {s}"] for s in RANGES]
    for cell in stored["cells"]:
        if cell["checkpoint"] == CHECKPOINTS[0] and cell["max_sv"]:
            at = {point["virtual_scale"]: psnr_kept(point) for point in cell["rows"]}
            for s, line in zip(RANGES, lines, strict=True):
                line.append(at[s] if s <= cell["max_sv"] else f"*{at[s]}*")
    return Table(["dial", *(f"max_sv {each}" for each in RANGES)], lines, [stored])


if __name__ == "__main__":
    main()
