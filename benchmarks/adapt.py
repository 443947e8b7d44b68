"""Quality, count and seconds of adapted checkpoints, by dial value.

    python benchmarks/adapt.py plush_half --set max_sv=20.0 --label "max_sv 20"

A scene is a folder of the shared data, followed by the name of the checkpoint where it is not
``pretrained``. Each run adds one row to ``results/adapt.jsonl``: settings, commit, machine, the
base and the dial.
"""

import ast
from dataclasses import asdict
from itertools import product

import clod_adapter as clod
from common import (
    Table,
    append,
    arguments,
    checkpoint,
    last,
    photographs,
    psnr_kept,
    quality,
)

FILE = "adapt.jsonl"
DIALS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 14.0)
LENGTHS = (1, 2, 3, 5, 7, 10, 20)  # of the table
SHARES = (0.62, 0.35, 0.12, 0.05, 0.02)  # of the base's Gaussians, where the file is also measured


def main():
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a field of AdaptConfig"
    )
    parser.add_argument("--label", default="default", help="name of the row")
    args = parser.parse_args()
    changed = dict(_setting(text) for text in args.set)
    for scene in args.scenes:
        run(scene, args.label, clod.AdaptConfig(**changed), changed)


def _setting(text):
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def run(scene, label, config, changed):
    base, views = checkpoint(scene).gaussians, photographs(scene)
    about = {"scene": scene, "label": label, "changed": changed, "base_count": len(base)}
    (base_row,) = quality(base, views.test, 1.0)
    append(FILE, {**about, "base": base_row, **adapted(base, views, views.test, config)})


def adapted(base, views, shown, config):
    """Adapts to ``views``, and measures on the views ``shown``."""
    dials = sorted({s for s in DIALS if s < config.max_sv} | {config.max_sv})
    plan = clod.make_plan(base, views, config)
    result = plan.adapt(views)
    return {
        "config": asdict(config),
        "rows": quality(result.gaussians, shown, dials),
        "at_shares": at_shares(result.gaussians, shown),
        "steps": result.steps,
        "share": plan.config.start_share,
        "start_seconds": round(plan.seconds["bands"] + result.start_seconds, 2),
        "train_seconds": round(result.seconds, 2),
    }


def at_shares(model, views):
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


def page_table():
    """Dials of two lengths on two captures."""
    found = last(FILE, "scene", "label")
    shown = {}
    for scene, length in product(("plush_half", "bonsai146"), (7, 20)):
        if (scene, f"max_sv {length}") in found:
            shown[f"{scene}, {length}"] = found[scene, f"max_sv {length}"]
    lines = []
    for s in LENGTHS:
        cells = [f"s = {s}"]
        for row in shown.values():
            at = {point["virtual_scale"]: psnr_kept(point) for point in row["rows"]}
            cells.append(at.get(s, ""))
        lines.append(cells)
    return Table(["dial", *shown], lines, shown.values())


if __name__ == "__main__":
    main()
