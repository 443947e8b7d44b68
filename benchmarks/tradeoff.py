"""Error against seconds of preparation: ours, the paper's form, prefixes and a specialist for each
dial value on held-out photographs; ours and halved sets on a large scene.

    python benchmarks/tradeoff.py plush_half bonsai146 SCENE.ply
    python benchmarks/tradeoff.py    # docs/images/error_vs_time.png of the stored rows

Each number of steps is a separate run with its own schedule. A specialist is the base merged to the
count that ours keeps at that dial value, by splat-transform, then tuned for as many steps; at s = 1
it is the whole base. Prefixes are one file, ordered by removal error and tuned with random
prefixes, of which the same counts are measured. SCENE.ply, without photographs, is drawn by the
rule of ``stream.py``, and times are of the whole command, also at its default. Rows go to
``results/tradeoff.jsonl``.
"""

import tempfile
import time
from functools import partial
from itertools import product
from pathlib import Path

import clod_adapter as clod
from clod_adapter.report.charts import draw_training, new_figure, save_figure
from common import (
    ROOT,
    append,
    arguments,
    checkpoint,
    clod_adapt,
    last,
    photographs,
    quality,
)
from stream import BUDGETS, SETS, Dial, halved, measured, of_files, of_sets, rendered
from tuning import Tuning, by_importance, merge, tune

FILE = "tradeoff.jsonl"
PICTURE = ROOT / "docs" / "images" / "error_vs_time.png"
ITERS = (150, 400, 1200)
MAX_SV, DIALS = 5.0, (1.0, 3.0, 5.0)
LABELS = {
    "ours": "ours, one file",
    "paper": "the paper's form, one file",
    "prefix": "prefixes, one file",
    "specialist": "specialists, a file each",
    "halved": "halved uniformly, a set",
    "halved adaptively": "halved adaptively, a set",
}
AT_DIALS = [f"s = {s:g}" for s in DIALS]
PANELS = {  # of a row of the picture
    "plush_half": AT_DIALS,
    "bonsai146": AT_DIALS,
    "showroom3": [f"{budget:.0%} in each frame" for budget in BUDGETS],
}


def main():
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*", help="folders of the shared data, or files")
    for scene in parser.parse_args().scenes:
        runs = of_file if scene.endswith(".ply") else of_capture
        for row in runs(scene):
            append(FILE, {"scene": Path(scene).stem, **row})
    plot()


def of_capture(scene):
    base, views = checkpoint(scene), photographs(scene)
    (untouched,) = quality(base.gaussians, views.test, 1.0)
    METHODS["ours"](scene, base, views, 1)  # compiles
    for method, iters in product(METHODS, ITERS):
        seconds, rows = METHODS[method](scene, base, views, iters)
        about = {"method": method, "iters": iters, "base": untouched}
        yield about | {"seconds": seconds, "rows": rows}


def of_file(scene):
    """At the budgets of a viewer."""
    base = clod.load(scene).gaussians
    views = rendered(base)
    with tempfile.TemporaryDirectory() as temporary:
        for iters in (*ITERS, "default"):
            out = Path(temporary) / f"{iters}.ply"
            words = [] if iters == "default" else ["--iters", iters]
            run = clod_adapt(scene, *words, "--out", out, "--accept-loss", "--quiet")
            shown = Dial(clod.load(out).gaussians)
            rows = [measured(shown, views, budget, len(base)) for budget in BUDGETS]
            seconds = [run.seconds] * len(BUDGETS)
            yield {"method": "ours", "iters": iters, "seconds": seconds, "rows": rows}
        for method, option in SETS.items():
            began = time.perf_counter()
            coarser = halved(scene, option, Path(temporary) / method)
            seconds = [time.perf_counter() - began] * len(BUDGETS)
            rows = list(of_sets(base, {method: of_files(scene, coarser)}, views))
            yield {"method": method, "seconds": seconds, "rows": rows}


def dial(config_of, scene, base, views, iters):
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


METHODS = {  # to seconds and quality at each dial value
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


def curves(runs, k):
    """Lines by method in the k-th panel, through runs by rising time."""
    lines = {method: [] for method in LABELS}
    for row in runs:
        point = {"seconds": row["seconds"][k], "psnr": row["rows"][k]["psnr"]}
        lines[row["method"]].append(point)
    return [{"label": LABELS[method], "points": line} for method, line in lines.items() if line]


def title(runs, scene, k):
    """Of the k-th panel, with the shares that the last runs of ours and of the paper's form keep;
    the others keep as many as ours, specialists at s = 1 all.
    """
    kept = {row["method"]: row["rows"][k].get("kept_share") for row in runs}
    if "paper" not in kept:
        return PANELS[scene][k]
    return f"{PANELS[scene][k]}, {kept['ours']:.0%} (the paper's form {kept['paper']:.0%})"


def plot():
    """A row a scene, a panel a dial value or budget: error against seconds."""
    with new_figure((13.8, 4.4 * len(PANELS)), layout="constrained") as figure:
        for part, scene in zip(figure.subfigures(len(PANELS)), PANELS, strict=True):
            runs = last(FILE, "method", "iters", scene=scene).values()
            base = next(iter(runs)).get("base")
            part.suptitle(scene, weight="bold", x=0.008, ha="left")
            for k, axes in enumerate(part.subplots(1, len(DIALS))):
                by_time = sorted(runs, key=lambda row: row["seconds"][k])
                draw_training(axes, curves(by_time, k), base and base["psnr"])
                axes.set_title(title(by_time, scene, k), loc="left", weight="bold")
                axes.get_legend().remove()
            # one legend for all panels
            named = axes.get_legend_handles_labels()
            part.legend(*named, loc="outside lower center", ncols=len(LABELS))
        save_figure(figure, PICTURE)
    print(PICTURE)


if __name__ == "__main__":
    main()
