"""Quality, count and seconds of adapted checkpoints, by dial value.

    python benchmarks/adapt.py plush_half --set max_sv=20.0 --label "max_sv 20" --seeds 0 1 2
    python benchmarks/adapt.py --table    # the rows as a Markdown table

A scene is a folder of the shared data, followed by the name of the checkpoint where it is not
``pretrained``. Each run adds one row to ``results/adapt.jsonl``: settings, commit, machine, the
base and the dial.
"""

import ast
from collections.abc import Sequence
from dataclasses import asdict
from statistics import fmean
from typing import Any

import clod_adapter as clod
from common import Row, append, arguments, checkpoint, photographs, quality, stored, table

FILE = "adapt.jsonl"
DIALS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 14.0)
SHARES = (0.62, 0.35, 0.12, 0.05, 0.02)  # of the base's Gaussians, where the file is also measured


def main() -> None:
    parser = arguments(__doc__, table=print_table)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a field of AdaptConfig"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--label", default="default", help="name of the row")
    args = parser.parse_args()
    changed = dict(_setting(text) for text in args.set)
    for scene in args.scenes:
        for seed in args.seeds:
            run(scene, args.label, clod.AdaptConfig(**{"seed": seed, **changed}), changed)


def _setting(text: str) -> tuple[str, Any]:
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def run(scene: str, label: str, config: clod.AdaptConfig, changed: Row) -> None:
    base, views = checkpoint(scene), photographs(scene)
    dials = sorted({s for s in DIALS if s < config.max_sv} | {config.max_sv})
    (base_row,) = quality(base.gaussians, views.test, 1.0)
    plan = clod.make_plan(base.gaussians, views, config)
    adapted = plan.adapt(views)
    adapter = clod.extract(
        base.gaussians, adapted.gaussians, fingerprint=base.fingerprint, config=asdict(config)
    )
    result = adapter.apply(base.gaussians)
    append(
        FILE,
        {
            "benchmark": "adapt",
            "scene": scene,
            "label": label,
            "changed": changed,
            "config": asdict(config),
            "base_count": len(base.gaussians),
            "base": base_row,
            "rows": quality(result, views.test, dials),
            "at_shares": at_shares(result, views.test),
            "steps": adapted.steps,
            "share": plan.config.share,
            "start_seconds": round(plan.seconds["bands"] + adapted.start_seconds, 2),
            "train_seconds": round(adapted.seconds, 2),
        },
    )


def at_shares(model: clod.Gaussians, views: Sequence[clod.View]) -> list[Row]:
    """Rows at the dial values that keep SHARES of the Gaussians, as far as the dial goes."""
    cameras = [view.camera for view in views]
    rows = []
    for share in SHARES:
        try:
            solved = clod.dial_for(model, keep=share * model.whole, cameras=cameras)
        except clod.ClodError:
            continue  # out of the dial's reach
        if not solved.note:
            (row,) = quality(model, views, solved.virtual_scale)
            rows.append({"share": share, **row})
    return rows


def psnr_at(row: Row, share: float) -> float | None:
    """PSNR of ``at_shares`` in a stored row; None where the dial does not go as far."""
    return next((point["psnr"] for point in row["at_shares"] if point["share"] == share), None)


def print_table() -> None:
    """PSNR at s = 1 and at the matched shares, means over the seeds, a line a setting."""
    groups: dict[tuple[str, str, int], dict[int, Row]] = {}
    for row in stored(FILE):
        by_seed = groups.setdefault((row["scene"], row["label"], row["steps"]), {})
        by_seed[row["config"]["seed"]] = row
    lines = []
    for key, by_seed in groups.items():
        runs = list(by_seed.values())
        seconds = fmean(run["start_seconds"] + run["train_seconds"] for run in runs)
        psnr = fmean(run["rows"][0]["psnr"] for run in runs)
        kept = fmean(run["rows"][0]["kept_share"] for run in runs)
        line = [*key, len(runs), f"{seconds:.0f}", f"{runs[0]['base']['psnr']:.2f}"]
        line.append(f"{psnr:.2f} @ {kept:.0%}")
        for share in SHARES:
            matched = [psnr_at(run, share) for run in runs]
            line.append("" if None in matched else f"{fmean(matched):.2f}")
        lines.append(line)
    heads = ["scene", "settings", "steps", "seeds", "seconds", "base", "s = 1"]
    print(table([*heads, *(f"{share:.0%}" for share in SHARES)], lines))


if __name__ == "__main__":
    main()
