"""Adapts real checkpoints and writes what came of it: quality, count and time per dial value.

    python benchmarks/adapt.py plush_half bonsai146 ci_banana plush_half/pretrained_mask
    python benchmarks/adapt.py plush_half --set lr_sigma=0.05 --set full_share=0 --label "slow sigma"
    python benchmarks/adapt.py plush_half --ablations      # one row for each choice in docs/method.md
    python benchmarks/adapt.py plush_half bonsai146 --leave-out    # one for each in docs/performance.md
    python benchmarks/adapt.py --table                     # the rows as a Markdown table

A scene is a folder of the shared data, with a checkpoint's name where it is not ``pretrained``. Each run
adds one row to ``results/adapt.jsonl``: the settings, the commit, the machine, the base and the dial.
"""

from __future__ import annotations

import argparse
import ast
import json
from dataclasses import asdict

from common import RESULTS, append, capture

import clod_adapter as clod

FILE = "adapt.jsonl"
DIALS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
ABLATION_STEPS = 600
# The default is an entry too: the others are compared with it at the same number of steps.
ABLATIONS: dict[str, dict[str, object]] = {
    "default, 600 steps": {},
    "never s = 1 on purpose": {"full_share": 0.0},
    "half the steps at s = 1": {"full_share": 0.5},
    "sigma ten times slower": {"lr_sigma": 0.01},
    "sigma three times faster": {"lr_sigma": 0.3},
    "other attributes half as fast": {
        "lr_means": 6.5e-5, "lr_quats": 4e-4, "lr_scales": 2e-3, "lr_opacities": 2.5e-2, "lr_sh0": 1e-3,
    },
    "other attributes frozen": {
        "lr_means": 0.0, "lr_quats": 0.0, "lr_scales": 0.0, "lr_opacities": 0.0, "lr_sh0": 0.0,
    },
    "higher bands tuned": {"lr_shN": 1e-4},
    "all dial values weigh alike": {"weight_slope": 0.0},
    "wider soft count": {"temperature": 1.0},
    "no count term": {"reg_weight": 0.0},
    "higher threshold": {"tau": 0.01},
    "normaliser quantile": {"normalizer": "quantile"},
    "normaliser max (the paper's)": {"normalizer": "max"},
    "start keeps more at s = 1": {"start_share": 0.8},
}  # fmt: skip


# What a step can leave out, at three lengths each: held-out error against time.
GEOMETRY = {"lr_means": 0.0, "lr_quats": 0.0, "lr_scales": 0.0}
LEAVE_OUT: dict[str, dict[str, object]] = {
    f"{label}, {iters} steps": {"iters": iters, **changed}
    for label, changed in (("default", {}), ("geometry frozen", GEOMETRY), ("higher bands tuned", {"lr_shN": 1e-4}))
    for iters in (500, 1000, 1500)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--ablations", action="store_true", help=f"every choice by itself, {ABLATION_STEPS} steps each")
    parser.add_argument("--leave-out", action="store_true", help="what a step can leave out, at three lengths each")
    parser.add_argument("--table", action="store_true", help="print the rows there are")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a field of AdaptConfig")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--label", default="default", help="what the row is for")
    args = parser.parse_args()
    if args.table:
        print_table()
    runs = {args.label: dict(_setting(text) for text in args.set)}
    if args.ablations:
        runs = {label: {"iters": ABLATION_STEPS, **changed} for label, changed in ABLATIONS.items()}
    if args.leave_out:
        runs = LEAVE_OUT
    for scene in args.scenes:
        for label, changed in runs.items():
            for seed in args.seeds:
                run(scene, label, clod.AdaptConfig(**{"seed": seed, **changed}), changed)


def print_table() -> None:
    """PSNR and share per dial value, a line a row of the results."""
    dials = [f"s = {s:g}" for s in DIALS]
    print("| scene | what | steps | seconds | base | " + " | ".join(dials) + " |")
    print("|---" * (5 + len(dials)) + "|")
    for line in (RESULTS / FILE).read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        seconds = row["start_seconds"] + row["train_seconds"]
        cells = [f"{r['psnr']:.2f} @ {r['kept_share']:.1%}" for r in row["rows"] if r["virtual_scale"] in DIALS]
        head = [row["scene"], row["label"], str(row["steps"]), f"{seconds:.0f}", f"{row['base']['psnr']:.2f}"]
        print("| " + " | ".join(head + cells) + " |")


def _setting(text: str) -> tuple[str, object]:
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def run(scene: str, label: str, config: clod.AdaptConfig, changed: dict[str, object]) -> None:
    folder, _, checkpoint = scene.partition("/")
    base = clod.load(capture(folder) / f"{checkpoint or 'pretrained'}.ply")
    photographs = clod.load_scene(capture(folder))
    dials = [s for s in DIALS if s <= config.max_sv] + ([config.max_sv] if config.max_sv > DIALS[-1] else [])
    base_row = clod.evaluate(base.gaussians, photographs.test, [1.0])[0]
    adapted = clod.adapt(base.gaussians, photographs, config)
    adapter = clod.extract(base.gaussians, adapted.gaussians, fingerprint=base.fingerprint, config=asdict(config))
    rows = clod.evaluate(adapter.apply(base.gaussians), photographs.test, dials)
    append(FILE, {
        "benchmark": "adapt", "scene": scene, "label": label, "changed": changed, "config": asdict(config),
        "base_count": len(base.gaussians), "base": base_row.as_dict(), "rows": [row.as_dict() for row in rows],
        "steps": adapted.steps, "start_seconds": round(adapted.start_seconds, 2),
        "train_seconds": round(adapted.seconds, 2),
    })  # fmt: skip


if __name__ == "__main__":
    main()
