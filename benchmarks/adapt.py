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
from common import Row, append, arguments, checkpoint, photographs, stored, table

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


def run(scene: str, label: str, config: clod.AdaptConfig, changed: dict[str, Any]) -> None:
    base, views = checkpoint(scene), photographs(scene)
    dials = sorted({s for s in DIALS if s < config.max_sv} | {config.max_sv})
    base_row = clod.evaluate(base.gaussians, views.test, [1.0])[0]
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
            "base": base_row.as_dict(),
            "rows": [row.as_dict() for row in clod.evaluate(result, views.test, dials)],
            "at_shares": at_shares(result, views.test),
            "steps": adapted.steps,
            "share": plan.config.share,
            "start_seconds": round(plan.seconds["bands"] + adapted.start_seconds, 2),
            "train_seconds": round(adapted.seconds, 2),
        },
    )


def at_shares(model: clod.Gaussians, views: Sequence[clod.View]) -> list[dict[str, float]]:
    """Rows at the dial values that keep SHARES of the Gaussians, as far as the dial goes."""
    found = []
    for share in SHARES:
        try:
            solved = clod.dial_for(
                model, keep=share * model.whole, cameras=[view.camera for view in views]
            )
        except clod.ClodError:
            continue  # out of the dial's reach
        if not solved.note:
            found.append(
                {"share": share, **clod.evaluate(model, views, [solved.virtual_scale])[0].as_dict()}
            )
    return found


def print_table() -> None:
    """PSNR at s = 1 and at the matched shares, means over the seeds, a line a setting."""
    groups: dict[tuple[str, str, int], dict[int, Row]] = {}
    for row in stored(FILE):
        groups.setdefault((row["scene"], row["label"], row["steps"]), {})[row["config"]["seed"]] = (
            row
        )
    lines = []
    for (scene, label, steps), seeds in groups.items():
        rows = list(seeds.values())
        full = [fmean(row["rows"][0][key] for row in rows) for key in ("psnr", "kept_share")]
        found = [
            [r["psnr"] for row in rows for r in row["at_shares"] if r["share"] == share]
            for share in SHARES
        ]
        cells = [f"{fmean(psnr):.2f}" if len(psnr) == len(rows) else "" for psnr in found]
        seconds = fmean(row["start_seconds"] + row["train_seconds"] for row in rows)
        head = [scene, label, steps, len(rows), f"{seconds:.0f}", f"{rows[0]['base']['psnr']:.2f}"]
        lines.append([*head, f"{full[0]:.2f} @ {full[1]:.0%}", *cells])
    heads = [
        "scene",
        "settings",
        "steps",
        "seeds",
        "seconds",
        "base",
        "s = 1",
        *(f"{share:.0%}" for share in SHARES),
    ]
    print(table(heads, lines))


if __name__ == "__main__":
    main()
