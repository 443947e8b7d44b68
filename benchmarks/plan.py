"""Savings and cost of the plan: the command with everything included, with the plan, and with --trim.

    python benchmarks/plan.py ci_banana --iters 300         # without a scene all of them; --table: the stored rows

A scene is a folder of the shared data, followed by the name of the checkpoint where it is not ``pretrained``, or a file
without photographs. Each run is a process of its own. Rows go to ``results/plan.jsonl``.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from common import COMMAND, Process, append, arguments, capture, print_rows

FILE = "plan.jsonl"
COLUMNS = (
    "scene",
    "steps",
    "way",
    "seconds.start",
    "seconds.train",
    "ply_mb",
    "adapter_mb",
    "peak_mb",
    "virtual_scale",
    "psnr",
    "kept",
)
SCENES = (
    "plush_half", "plush_half/pretrained_mask", "bonsai146", "ci_banana", "splats/lod_tiles/lod1_tile_0_0.5x.ply",
    "splats/playbot_lod4_from_sog.ply",
)  # fmt: skip
DIALS = (1.0, 3.0, 5.0)
WAYS = {"everything": ["--with", "bands", "unseen"], "plan": [], "plan, trimmed": ["--trim"]}


def main() -> None:
    parser = arguments(__doc__, table=lambda: print_rows(FILE, *COLUMNS))
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


if __name__ == "__main__":
    main()
