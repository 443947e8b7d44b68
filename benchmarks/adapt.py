"""Adapts real checkpoints and writes what came of it: quality, count and time per dial value.

    python benchmarks/adapt.py plush_half bonsai146 ci_banana plush_half/pretrained_mask
    python benchmarks/adapt.py plush_half --set lr_sigma=0.05 --set full_share=0 --label "slow sigma"

A scene is a folder of the shared data, with a checkpoint's name where it is not ``pretrained``. Each run
adds one row to ``results/adapt.jsonl``: the settings, the commit, the machine, the base and the dial.
"""

from __future__ import annotations

import argparse
import ast
import resource
from dataclasses import asdict

from common import append, capture

import clod_adapter as clod

DIALS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a field of AdaptConfig")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--label", default="default", help="what the row is for")
    args = parser.parse_args()
    changed = dict(_setting(text) for text in args.set)
    for scene in args.scenes:
        for seed in args.seeds:
            run(scene, args.label, clod.AdaptConfig(**{"seed": seed, **changed}), changed)


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
    append("adapt.jsonl", {
        "benchmark": "adapt", "scene": scene, "label": label, "changed": changed, "config": asdict(config),
        "base_count": len(base.gaussians), "base": base_row.as_dict(), "rows": [row.as_dict() for row in rows],
        "steps": adapted.steps, "start_seconds": round(adapted.start_seconds, 2),
        "train_seconds": round(adapted.seconds, 2),
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    })  # fmt: skip


if __name__ == "__main__":
    main()
