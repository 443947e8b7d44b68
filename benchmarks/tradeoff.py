"""Held-out error against seconds of training: ours, the paper's form, prefixes, a specialist for
each dial value.

    python benchmarks/tradeoff.py plush_half
    python benchmarks/tradeoff.py plush_half --plot    # docs/images/error_vs_time.png, stored rows

Each number of steps is a separate run with its own schedule. A specialist is the base merged to the
count that ours keeps at that dial value, by the better of splat-transform's methods, then tuned for
as many steps; at s = 1 the whole base, tuned. Prefixes are one file, ordered by removal error and
tuned with random prefixes, of which the same counts are measured. Each run adds a row to
``results/tradeoff.jsonl``.
"""

import time
from functools import partial
from itertools import product

import clod_adapter as clod
from clod_adapter.report.charts import draw_training, new_figure, save_figure
from common import (
    ROOT,
    Row,
    Table,
    append,
    arguments,
    checkpoint,
    last,
    photographs,
    psnr_kept,
    quality,
    stored,
)
from tuning import Tuning, by_importance, merge, tune

FILE, SCENE = "tradeoff.jsonl", "plush_half"  # of the page
PICTURE = ROOT / "docs" / "images" / "error_vs_time.png"
ITERS = (150, 400, 1200)
MAX_SV, DIALS = 5.0, (1.0, 3.0, 5.0)
LABELS = {
    "ours": "ours, one file",
    "paper": "the paper's form, one file",
    "prefix": "prefixes, one file",
    "specialist": "specialists, a file each",
}


def main():
    parser = arguments(__doc__)
    parser.add_argument("scene", help="a folder of the shared data")
    parser.add_argument("--plot", action="store_true", help="only draw the stored rows")
    args = parser.parse_args()
    if not args.plot:
        base, views = checkpoint(args.scene), photographs(args.scene)
        (untouched,) = quality(base.gaussians, views.test, 1.0)
        for method, iters in product(LABELS, ITERS):
            about = {"scene": args.scene, "method": method, "iters": iters, "max_sv": MAX_SV}
            seconds, rows = METHODS[method](args.scene, base, views, iters)
            append(FILE, {**about, "seconds": seconds, "base": untouched, "rows": rows})
    plot(args.scene)


Runs = tuple[list[float], list[Row]]  # seconds to the file of each dial value, and its row


def dial(
    config_of,
    scene,
    base,
    views,
    iters,
):
    adapted = clod.adapt(base.gaussians, views, config_of(max_sv=MAX_SV, iters=iters))
    seconds = adapted.start_seconds + adapted.seconds
    return [seconds] * len(DIALS), quality(adapted.gaussians, views.test, DIALS)


def specialists(scene, base, views, iters):
    """Merging is within the time."""
    seconds, rows = [], []
    for s, count in zip(DIALS, counts(scene), strict=True):
        start, merging = merge(base, count, "--decimate") if s > 1 else (base.gaussians, 0.0)
        tuned, tuning = tune(start, views.train, Tuning(iters=iters))
        rows.append(row_of(tuned, views, s, len(base.gaussians)))
        seconds.append(merging + tuning)
    return seconds, rows


def prefixes(scene, base, views, iters):
    """Ordering is within the time."""
    began = time.perf_counter()
    start = by_importance(base.gaussians, views.train)
    ordering = time.perf_counter() - began
    tuned, tuning = tune(start, views.train, Tuning(iters=iters, prefixes=True))
    rows = [
        row_of(tuned[:count], views, s, len(base.gaussians))
        for s, count in zip(DIALS, counts(scene), strict=True)
    ]
    return [ordering + tuning] * len(DIALS), rows


METHODS = {
    "ours": partial(dial, clod.AdaptConfig),
    "paper": partial(dial, clod.AdaptConfig.paper),
    "prefix": prefixes,
    "specialist": specialists,
}


def row_of(file, views, s, count):
    (row,) = quality(file, views.test, 1.0)
    return row | {"virtual_scale": s, "kept_share": len(file) / count}


def counts(scene):
    """Gaussians that ours keeps at each dial value in its longest run, of equal ones the last."""
    runs = last(FILE, "iters", scene=scene, method="ours")
    return [round(row["kept"]) for row in runs[max(runs)]["rows"]]


def curves(scene, k):
    """Lines by method at the k-th dial value, by rising time; of equal runs the last."""
    runs = last(FILE, "method", "iters", scene=scene)
    points = {method: [] for method in LABELS}
    for (method, _), row in sorted(runs.items()):
        point = row["rows"][k]
        points[method].append({"seconds": row["seconds"][k], "psnr": point["psnr"]})
    return [{"label": LABELS[method], "points": line} for method, line in points.items() if line]


def page_table():
    """Seconds and quality of each run; the seconds of specialists are those of all their files."""
    found = last(FILE, "method", "iters", scene=SCENE)
    lines = []
    for (method, iters), row in found.items():
        seconds = sum(row["seconds"]) if method == "specialist" else row["seconds"][0]
        cells = map(psnr_kept, row["rows"])
        lines.append([LABELS[method], f"{iters:,}", f"{seconds:.0f}", *cells])
    heads = ["", "steps", "seconds", *(f"s = {s:g}" for s in DIALS)]
    return Table(heads, lines, found.values())


def plot(scene):
    """A panel a dial value: error against seconds of training."""
    base = stored(FILE)[-1]["base"]
    with new_figure((4.6 * len(DIALS), 4.3), layout="constrained") as figure:
        title = f"{scene}: held-out error against time of training, {base['kept']:,.0f} Gaussians"
        figure.suptitle(title, fontsize=11.5, weight="bold", x=0.008, ha="left")
        for k, (axes, s) in enumerate(zip(figure.subplots(1, len(DIALS)), DIALS, strict=True)):
            draw_training(axes, curves(scene, k), base["psnr"])
            axes.set_title(f"s = {s:g}", loc="left", fontsize=10, weight="bold")
            axes.get_legend().remove()
        # one legend for all panels
        named = axes.get_legend_handles_labels()
        figure.legend(*named, loc="outside lower center", ncols=len(LABELS) + 1)
        save_figure(figure, PICTURE)
    print(PICTURE)


if __name__ == "__main__":
    main()
