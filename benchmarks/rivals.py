"""Other methods on the same checkpoint and photographs, at fixed shares of the base's Gaussians.

    python benchmarks/rivals.py plush_half bonsai146 --iters 1500
    python benchmarks/rivals.py --table                    # the rows as a Markdown table

- ``merging``: ``splat-transform``, both of its methods, without training, one file per count;
- ``specialist``: the merged file, tuned for that count alone;
- ``tuned``: the whole base, tuned for as many steps;
- ``prefix``: one file whose prefixes are the counts, tuned with random prefixes (``tuning.tune``);
- ``ranking``: prefixes without tuning, ordered by opacity, by contribution and by removal error.

A scene is named as for adapt.py. Each run adds a row to ``results/rivals.jsonl``.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from statistics import fmean
from typing import Any

import clod_adapter as clod
from clod_adapter.cli.shared.console import Console
from clod_adapter.initialization.coverage import coverage
from clod_adapter.initialization.importance import removal_error
from common import append, arguments, checkpoint, falling, head, photographs, stored, table
from tuning import MERGINGS, Tuning, find_tool, merge, tune

import torch
from torch import Tensor

FILE = "rivals.jsonl"
RIVALS = ("merging", "specialist", "tuned", "prefix", "ranking")
SHARES = (0.62, 0.35, 0.12, 0.05, 0.02)
ORDERS = ("opacity", "contribution", "removal error")


def main() -> None:
    parser = arguments(__doc__, table=print_table)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--only", nargs="+", choices=RIVALS, default=RIVALS, help="some of the rivals")
    parser.add_argument("--shares", nargs="+", type=float, default=SHARES, help="of the base's Gaussians")
    parser.add_argument("--iters", type=int, default=1500, help="steps of tuning")
    parser.add_argument("--seed", nargs="+", type=int, default=[0])
    args = parser.parse_args()
    for scene in args.scenes:
        contest = Contest(scene, args)
        for rival in args.only:
            getattr(contest, rival)()


class Contest:
    """One scene and its rivals; each method adds its rows."""

    def __init__(self, scene: str, args: argparse.Namespace) -> None:
        self.scene, self.args, self.console = scene, args, Console()
        self.base, self.photographs = checkpoint(scene), photographs(scene)
        self.counts = {share: max(round(share * len(self.base.gaussians)), 1) for share in args.shares}
        self.base_row = self.measure(self.base.gaussians, 1.0)

    def measure(self, gaussians: clod.Gaussians, share: float) -> dict[str, float]:
        row = clod.evaluate(gaussians, self.photographs.test, [1.0])[0]
        self.console.say(f"{self.scene}: {row.psnr:.2f} dB, {row.ssim:.4f} with {len(gaussians)} ({share:.0%})")
        return {
            "share": share, "count": len(gaussians), "psnr": row.psnr, "ssim": row.ssim, "in_view": row.in_view,
            "frame_ms": row.frame_ms,
        }  # fmt: skip

    def record(self, rival: str, label: str, rows: list[dict[str, float]], **more: Any) -> None:
        append(FILE, {
            "benchmark": "rivals", "scene": self.scene, "rival": rival, "label": label,
            "base_count": len(self.base.gaussians), "base": self.base_row, "rows": rows, **more,
        })  # fmt: skip

    def merging(self) -> None:
        for method in MERGINGS:
            rows = []
            for share, count in self.counts.items():
                merged, seconds = merge(self.base, count, method)
                rows.append({**self.measure(merged, share), "seconds": seconds})
            self.record("merging", f"splat-transform {find_tool().version} {method}", rows)

    def specialist(self) -> None:
        for share, count in self.counts.items():
            merged, seconds = merge(self.base, count)
            for seed in self.args.seed:
                self.tune(
                    "specialist", f"merged {MERGINGS[0]}, then tuned", merged, seed, [share], merge_seconds=seconds
                )

    def tuned(self) -> None:
        for seed in self.args.seed:
            self.tune("tuned", "tuned base", self.base.gaussians, seed, [1.0])

    def prefix(self) -> None:
        for seed in self.args.seed:
            start, label = self.base.gaussians.select(self.ranked(ORDERS[-1], seed)), f"prefixes by {ORDERS[-1]}"
            self.tune("prefix", f"{label}, lengths log", start, seed, [1.0, *self.counts], order=ORDERS[-1])

    def ranking(self) -> None:
        for order in ORDERS:
            ranked = self.base.gaussians.select(self.ranked(order, self.args.seed[0]))
            rows = [self.measure(head(ranked, count), share) for share, count in self.counts.items()]
            self.record("ranking", f"untouched, by {order}", rows)

    def tune(self, rival: str, label: str, start: clod.Gaussians, seed: int, shares: list[float], **more: Any) -> None:
        """Tunes for one share, or with random prefixes for several, and adds the row."""
        config = Tuning(iters=self.args.iters, seed=seed, draw="log" if len(shares) > 1 else None)
        with self.console.meter(f"{self.scene}, {label}, seed {seed}") as meter:
            done = tune(start, self.photographs.train, config, meter.update)
        files = (head(done.gaussians, self.counts[share]) if config.draw and share < 1 else done.gaussians
                 for share in shares)  # fmt: skip
        rows = [self.measure(gaussians, share) for gaussians, share in zip(files, shares, strict=True)]
        about = {"config": asdict(config), "steps": done.steps, "train_seconds": round(done.seconds, 2)}
        self.record(rival, label, rows, **about, **more)

    def ranked(self, order: str, seed: int) -> Tensor:
        """``[N]`` rows of the base, the most important first."""
        gaussians, views = self.base.gaussians, self.photographs.train
        if order == "opacity":
            worth = gaussians.opacity_logits
        elif order == "contribution":
            worth = sum((coverage(gaussians, gaussians.opacities, view.camera) for view in views), torch.zeros(()))
        else:
            worth = removal_error(gaussians, views, seed=seed)
        return falling(worth)


def print_table() -> None:
    """PSNR per share, a line for a rival at one length of tuning: the mean over seeds, of a seed the last row."""
    shares = (1.0, *SHARES)
    groups: dict[tuple[Any, ...], dict[int, dict[str, Any]]] = {}
    for row in stored(FILE):
        config = row.get("config", {"seed": 0})
        at = [point["share"] for point in row["rows"]]
        key = row["scene"], row["rival"], row["label"], json.dumps({**config, "seed": 0, "shares": at})
        groups.setdefault(key, {})[config["seed"]] = row
    lines = []
    for (scene, rival, label, _), seeds in groups.items():
        rows = list(seeds.values())
        times = [
            f"{fmean(row[name] for row in rows):.0f}" if name in rows[0] else "-" for name in ("steps", "train_seconds")
        ]
        values = [[p["psnr"] for row in rows for p in row["rows"] if p["share"] == share] for share in shares]
        cells = [f"{fmean(found):.2f}" if found else "" for found in values]
        lines.append([scene, f"{rival}: {label}", len(rows), *times, f"{rows[0]['base']['psnr']:.2f}", *cells])
    print(table(["scene", "rival", "seeds", "steps", "seconds", "base", *(f"{share:.0%}" for share in shares)], lines))


if __name__ == "__main__":
    main()
