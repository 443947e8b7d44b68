"""Held-out error against seconds of training: ours, the paper's form, prefixes, a specialist for each dial value.

    python benchmarks/tradeoff.py plush_half
    python benchmarks/tradeoff.py plush_half --plot     # docs/error_vs_time.html and its PNG, from the stored rows

Each number of steps is a separate run with its own schedule. A specialist is the base merged to the count that ours
keeps at that dial value, by the better of splat-transform's methods, then tuned for as many steps; at s = 1 the whole
base, tuned. Prefixes are one file, ordered by removal error and tuned with random prefixes, of which the same counts
are measured. Each run adds a row to ``results/tradeoff.jsonl``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from statistics import fmean

import clod_adapter as clod
from clod_adapter.cli.shared.console import Console
from clod_adapter.initialization.importance import removal_error
from clod_adapter.report import page
from clod_adapter.report.charts import draw_training, error, inline_svg, training_chart
from clod_adapter.report.style import new_figure, save_figure
from common import RESULTS, ROOT, Row, append, arguments, checkpoint, falling, head, photographs, stored
from tuning import Tuning, merge, tune

FILE = "tradeoff.jsonl"
PAGE = ROOT / "docs" / "error_vs_time.html"
PICTURE = ROOT / "docs" / "images" / "error_vs_time.png"
ITERS = (150, 400, 1200)
MAX_SV, DIALS = 5.0, (1.0, 3.0, 5.0)
CAPTION = (
    "Each point is the mean of runs with one length, each with its own schedule and measured after its end; the clock "
    "includes the start of ours and a specialist's merging. The dashed line is the base, untouched and whole."
)
READING = (
    (
        "One checkpoint ({given}) was given to four methods, each for several lengths of training. Ours, the paper's "
        "form and prefixes make one file for all dial values, so their seconds are paid once. A prefix is the count "
        "that ours keeps of a file in order of removal error, tuned with random prefixes. A specialist is a file for "
        "one dial value alone, the base merged to that count and then tuned: its seconds are paid for each.",
        "lead",
    ),
    ("Down and to the left is better: less error after less time. Both axes are logarithmic.", ""),
)
LABELS = {
    "ours": "ours, one file", "paper": "the paper's form, one file", "prefix": "prefixes, one file",
    "specialist": "specialists, a file each",
}  # fmt: skip


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scene", help="a folder of the shared data")
    parser.add_argument("--iters", nargs="+", type=int, default=list(ITERS))
    parser.add_argument("--only", nargs="+", choices=LABELS, default=list(LABELS), help="some of the methods")
    parser.add_argument("--plot", action="store_true", help="only draw the stored rows")
    args = parser.parse_args()
    if args.plot:
        plot(args.scene)
        return
    base, views = checkpoint(args.scene), photographs(args.scene)
    about = {"base": clod.evaluate(base.gaussians, views.test, [1.0])[0].as_dict()}
    for method in args.only:
        for iters in args.iters:
            with Console().meter(f"{args.scene}, {method}, {iters} steps") as meter:
                if method in ("specialist", "prefix"):
                    made = specialists if method == "specialist" else prefixes
                    seconds, rows = made(base, views, counts(args.scene), iters, meter.update)
                else:
                    seconds, rows = dial(method, base, views, iters, meter.update)
            append(FILE, {
                "benchmark": "tradeoff", "scene": args.scene, "method": method, "iters": iters, "seed": 0,
                "max_sv": MAX_SV, "seconds": seconds, **about, "rows": rows,
            })  # fmt: skip


def dial(
    method: str, base: clod.Checkpoint, views: clod.Scene, iters: int, follow: Callable[[float], None]
) -> tuple[list[float], list[Row]]:
    """Seconds (of the one run that serves every dial value) and the row of each dial value."""
    config = (clod.AdaptConfig if method == "ours" else clod.AdaptConfig.paper)(max_sv=MAX_SV, iters=iters, seed=0)
    done = clod.adapt(base.gaussians, views, config, lambda p: follow(p.share if p.phase == "training" else 0.0))
    rows = clod.evaluate(done.gaussians, views.test, DIALS)
    return [done.start_seconds + done.seconds] * len(rows), [row.as_dict() for row in rows]


def specialists(
    base: clod.Checkpoint, views: clod.Scene, counts: list[int], iters: int, follow: Callable[[float], None]
) -> tuple[list[float], list[Row]]:
    """Seconds and row of the specialist for each dial value; merging is within its time."""
    seconds, rows = [], []
    for s, count in zip(DIALS, counts, strict=True):
        start, merging = merge(base, count, "--decimate") if s > 1 else (base.gaussians, 0.0)
        tuned = tune(start, views.train, Tuning(iters=iters), lambda share, text: follow(share))
        row = clod.evaluate(tuned.gaussians, views.test, [1.0])[0].as_dict()
        rows.append(row | {"virtual_scale": s, "kept_share": row["kept"] / len(base.gaussians)})
        seconds.append(merging + tuned.seconds)
    return seconds, rows


def prefixes(
    base: clod.Checkpoint, views: clod.Scene, counts: list[int], iters: int, follow: Callable[[float], None]
) -> tuple[list[float], list[Row]]:
    """Seconds of the one run and the row of each count; ordering is within its time."""
    began = time.perf_counter()
    start = base.gaussians.select(falling(removal_error(base.gaussians, views.train)))
    ordering = time.perf_counter() - began
    tuned = tune(start, views.train, Tuning(iters=iters, draw="log"), lambda share, text: follow(share))
    rows = []
    for s, count in zip(DIALS, counts, strict=True):
        row = clod.evaluate(head(tuned.gaussians, count), views.test, [1.0])[0].as_dict()
        rows.append(row | {"virtual_scale": s, "kept_share": count / len(base.gaussians)})
    return [ordering + tuned.seconds] * len(rows), rows


def counts(scene: str) -> list[int]:
    """Gaussians that ours keeps at each dial value in its longest run, of equal ones the last."""
    longest = max((r for r in reversed(rows_of(scene)) if r["method"] == "ours"), key=lambda r: r["iters"])
    return [round(row["kept"]) for row in longest["rows"]]


def rows_of(scene: str) -> list[Row]:
    return [row for row in stored(FILE) if (row["scene"], row["max_sv"]) == (scene, MAX_SV)]


def plot(scene: str) -> None:
    """A panel a dial value: error against seconds of training, the mean over seeds of the last row of each."""
    rows = list({(r["method"], r["iters"], r["seed"]): r for r in rows_of(scene)}.values())  # the last of each
    if not rows:
        sys.exit(f"there are no rows of {scene} in {RESULTS / FILE}")
    dials = [row["virtual_scale"] for row in rows[-1]["rows"]]
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    with new_figure((4.6 * len(dials), 4.3), layout="constrained") as figure:
        title = f"{scene}: held-out error against time of training, {rows[-1]['base']['kept']:,.0f} Gaussians"
        figure.suptitle(title, fontsize=11.5, weight="bold", x=0.008, ha="left")
        for k, (axes, s) in enumerate(zip(figure.subplots(1, len(dials), squeeze=False)[0], dials, strict=True)):
            draw_training(axes, lines(curves(rows, k)), rows[-1]["base"]["psnr"])
            axes.set_title(f"s = {s:g}", loc="left", fontsize=10, weight="bold")
        save_figure(figure, PICTURE)
    write(scene, rows, dials)
    print(f"{PICTURE}\n{PAGE}")


def write(scene: str, rows: list[Row], dials: list[float]) -> None:
    """The page: settings, one chart per dial value, and a table of all numbers."""
    base = rows[-1]["base"]
    given = f"{scene}, {base['kept']:,.0f} Gaussians, {base['psnr']:.2f} dB on held-out photographs"
    body = [page.paragraph(text.format(given=given), kind) for text, kind in READING]
    cells = []
    for k, s in enumerate(dials):
        found = curves(rows, k)
        chart = training_chart(lines(found), base["psnr"])
        svg = inline_svg(chart, f"held-out error at s = {s:g} against seconds of training")
        title = "full quality" if s == 1 else "the end of the dial" if s == dials[-1] else "between"
        body.append(page.section(f"s = {s:g}: {title}", page.chart(svg, CAPTION)))
        cells += [(f"s = {s:g}, {label}", [row_of(*point) for point in points]) for label, points in found.items()]
    head = ("seconds", "PSNR dB", "mean squared error, thousandths", "Gaussians kept")
    body.append(page.section("All rows", page.html_table(head, cells)))
    facts = rows[-1]["machine"] | {"max_sv": MAX_SV, "command": f"python benchmarks/tradeoff.py {scene}"}
    facts["commits"] = ", ".join(sorted({row["commit"] for row in rows}))
    body.append(page.section("What it was run with", page.facts(facts)))
    page.write_page(PAGE, "Held-out error against seconds of training", "clod-adapter, benchmark", body, {"rows": rows})


def curves(rows: Sequence[Row], k: int) -> dict[str, list[tuple[float, float, float]]]:
    """The curve of each method that has one, by its label."""
    found = {label: curve([r for r in rows if r["method"] == method], k) for method, label in LABELS.items()}
    return {label: points for label, points in found.items() if points}


def lines(found: dict[str, list[tuple[float, float, float]]]) -> list[Row]:
    """The curves as the charts take them."""
    return [
        {
            "label": f"{label} ({points[-1][2]:.0%} kept)",
            "points": [{"seconds": seconds, "psnr": psnr} for seconds, psnr, _ in points],
        }
        for label, points in found.items()
    ]


def row_of(seconds: float, psnr: float, share: float) -> list[str]:
    return [f"{seconds:.0f}", f"{psnr:.2f}", f"{1e3 * error(psnr):.3f}", f"{share:.1%}"]


def curve(rows: Sequence[Row], k: int) -> list[tuple[float, float, float]]:
    """(seconds, PSNR, share kept) a budget, at the k-th dial value."""
    found = []
    for iters in sorted({row["iters"] for row in rows}):
        runs = [row for row in rows if row["iters"] == iters]
        each = [(run["seconds"][k], run["rows"][k]["psnr"], run["rows"][k]["kept_share"]) for run in runs]
        found.append(tuple(fmean(column) for column in zip(*each, strict=True)))
    return found


if __name__ == "__main__":
    main()
