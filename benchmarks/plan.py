"""Savings and cost of the plan: the command with everything included, with the plan, and with --trim.

    python benchmarks/plan.py                               # every scene of the shared data, one row per run
    python benchmarks/plan.py ci_banana --iters 300
    python benchmarks/plan.py --table                       # the last rows as Markdown, for docs/plan.md

A scene is a folder of the shared data, followed by the name of the checkpoint where it is not ``pretrained``, or a file
without photographs. Each run is a process of its own. Rows go to ``results/plan.jsonl``.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from common import COMMAND, Process, append, arguments, capture, stored, table

FILE = "plan.jsonl"
SCENES = (
    "plush_half", "plush_half/pretrained_mask", "bonsai146", "ci_banana", "splats/lod_tiles/lod1_tile_0_0.5x.ply",
    "splats/playbot_lod4_from_sog.ply",
)  # fmt: skip
DIALS = (1.0, 3.0, 5.0)
WAYS = {"everything": ["--with", "bands", "unseen"], "plan": [], "plan, trimmed": ["--trim"]}


def main() -> None:
    parser = arguments(__doc__, table=print_table)
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--iters", type=int, default=1500)
    args = parser.parse_args()
    for scene in args.scenes:
        for way, options in WAYS.items():
            about = {"benchmark": "plan", "scene": scene, "way": way, "label": "default"}
            append(FILE, about | run(scene, ["--iters", str(args.iters), *options]))


def run(scene: str, options: list[str]) -> dict[str, Any]:
    """One ``clod-adapt`` in a process of its own: times, sizes, peak of memory, and the dial's rows."""
    name, _, file = scene.partition("/")
    folder = capture(name)
    source, words = folder / f"{file or 'pretrained'}.ply", ["--images", folder]
    if file.endswith(".ply"):
        source, words = folder / file, []
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "dial.ply"
        process = Process([*COMMAND, source, *words, *options, "--out", out, "--quiet"])
        report = json.loads(out.with_suffix(".json").read_text())
    return {
        "steps": report["steps"], "seed": report["config"]["seed"], "base_count": report["base_count"],
        "wall_seconds": round(process.seconds, 2), "seconds": report["seconds"], "plan": report["plan"],
        "ply_mb": report["ply_bytes"] / 1e6, "adapter_mb": report["adapter_bytes"] / 1e6,
        "peak_mb": process.peak_bytes / 1024e3,
        "base_psnr": report["base_rows"][0]["psnr"] if report["base_rows"] else None,
        "rows": [row for row in report["rows"] if row["virtual_scale"] in DIALS],
    }  # fmt: skip


def print_table() -> None:
    """The last row of each scene, way and number of steps."""
    last: dict[tuple[str, int, str], dict[str, Any]] = {}
    for row in stored(FILE):
        if row["label"] == "default":
            last[row["scene"], row["steps"], row["way"]] = row
    lines, decisions = [], []
    for (scene, steps, way), row in last.items():
        # Rows from before attributes were only frozen by hand also have a time, and decisions, of attributes.
        plan = sum(row["plan"]["seconds"].get(part, 0.0) for part in ("bands", "unseen", "trim"))
        times = [f"{seconds:.1f}" for seconds in (plan, row["seconds"]["start"], row["seconds"]["train"])]
        sizes = [f"{row['ply_mb']:.1f}", f"{row['adapter_mb']:.2f}", f"{row['peak_mb']:.0f}"]
        lines.append([scene, steps, way, *times, *sizes, *(f"{r['psnr']:.2f} ({r['kept']:,.0f})" for r in row["rows"])])
        for made in row["plan"]["decisions"] if way == "plan, trimmed" else ():
            if made["verdict"] != "trained":
                decisions.append([scene, made["what"], made["verdict"], f"{made['measured']} {made['why']}"])
    heads = ["scene", "steps", "run", "plan s", "start s", "train s", "PLY MB", "adapter MB", "peak MB"]
    print(table([*heads, *(f"dB at {s:g} (kept)" for s in DIALS)], lines, 3), end="\n\n")
    print(table(["scene", "item", "decision", "number"], decisions))


if __name__ == "__main__":
    main()
