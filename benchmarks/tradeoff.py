"""Held-out error against seconds of training: ours, the paper's form, and a specialist for each dial value.

    python benchmarks/tradeoff.py plush_half                  # all methods at all budgets, an hour or so
    python benchmarks/tradeoff.py plush_half --methods ours paper --iters 150 300 --seeds 0 1 2
    python benchmarks/tradeoff.py plush_half --plot           # docs/error_vs_time.html and its PNG of the stored rows

A budget is a number of steps; each is a run of its own with its own schedule. A specialist is made for one count, which
ours keeps at that dial value in its longest run (so run ours first): the base merged to it, then tuned for as many
steps; at s = 1 the whole base, tuned. Each run adds a row to ``results/tradeoff.jsonl``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from statistics import fmean
from typing import Any

from common import CACHE, RESULTS, ROOT, append, arguments, checkpoint, photographs
from common import stored as stored_rows

import clod_adapter as clod
from clod_adapter.cli.shared.console import Console
from clod_adapter.report import page
from clod_adapter.report.charts import draw_training, error, inline_svg, training_chart
from clod_adapter.report.style import new_figure, save_figure

FILE = "tradeoff.jsonl"
PAGE = ROOT / "docs" / "error_vs_time.html"
PICTURE = ROOT / "docs" / "images" / "error_vs_time.png"
ITERS = (150, 300, 600, 1500)
CAPTION = (
    "Each point is the mean of runs with one length, each with its own schedule and measured after its end; the clock "
    "includes the start of ours and a specialist's merging. The dashed line is the base, untouched and whole."
)
READING = (
    (
        "One checkpoint ({given}) was given to three methods, each for several lengths of training. Ours and the "
        "paper's form make one file for all dial values, so their seconds are paid once. A specialist is a file for "
        "one dial value alone, the base merged to the count that ours keeps there and then tuned: its seconds are paid "
        "for each.",
        "lead",
    ),
    ("Down and to the left is better: less error after less time. Both axes are logarithmic.", ""),
)
LABELS = {"ours": "ours, one file", "paper": "the paper's form, one file", "specialist": "specialists, a file each"}


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scene", help="a folder of the shared data")
    parser.add_argument("--methods", nargs="+", choices=LABELS, default=list(LABELS))
    parser.add_argument("--iters", nargs="+", type=int, default=list(ITERS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--max-sv", type=float, default=5.0)
    parser.add_argument("--plot", action="store_true", help="only draw the stored rows")
    args = parser.parse_args()
    if args.plot:
        plot(args.scene, args.max_sv)
        return
    contest = Contest(args.scene, args.max_sv)
    for method in args.methods:
        for iters in args.iters:
            for seed in args.seeds:
                contest.run(method, iters, seed)


class Contest:
    """The runs on one scene."""

    def __init__(self, scene: str, max_sv: float) -> None:
        self.scene, self.max_sv, self.console = scene, max_sv, Console()
        self.base, self.photographs = checkpoint(scene), photographs(scene)
        self.dials = sorted({1.0, min(3.0, max_sv), max_sv})
        self.base_row = clod.evaluate(self.base.gaussians, self.photographs.test, [1.0])[0]

    def run(self, method: str, iters: int, seed: int) -> None:
        if method == "specialist":
            seconds, rows = self.specialists(iters, seed)
        else:
            seconds, rows = self.dial(method, iters, seed)
        append(FILE, {
            "benchmark": "tradeoff", "scene": self.scene, "method": method, "iters": iters, "seed": seed,
            "max_sv": self.max_sv, "seconds": seconds, "base": self.base_row.as_dict(), "rows": rows,
        })  # fmt: skip

    def dial(self, method: str, iters: int, seed: int) -> tuple[list[float], list[dict[str, float]]]:
        """Seconds (of the one run that serves every dial value) and the row of each dial value."""
        make = clod.AdaptConfig if method == "ours" else clod.AdaptConfig.paper
        config = make(max_sv=self.max_sv, iters=iters, seed=seed)
        done = self.watched(f"{method}, {iters} steps", lambda follow: clod.adapt(
            self.base.gaussians, self.photographs, config, lambda p: follow(p.share if p.phase == "training" else 0.0)
        ))  # fmt: skip
        rows = clod.evaluate(done.gaussians, self.photographs.test, self.dials)
        return [done.start_seconds + done.seconds] * len(rows), [row.as_dict() for row in rows]

    def specialists(self, iters: int, seed: int) -> tuple[list[float], list[dict[str, float]]]:
        """Seconds and row of the specialist for each dial value; merging is within its time."""
        from merging import Merger  # only here: it needs splat-transform
        from tuning import Tuning, tune

        seconds, rows = [], []
        for s, count in zip(self.dials, self.counts(), strict=True):
            start, merging = self.base.gaussians, 0.0
            if s > 1:
                start, merging = Merger.find(CACHE).merge(self.base, count)
            tuned = self.watched(
                f"specialist for {len(start):,}, {iters} steps",
                lambda follow, start=start: tune(
                    start, self.photographs.train, Tuning(iters=iters, seed=seed), lambda share, text: follow(share)
                ),
            )
            row = clod.evaluate(tuned.gaussians, self.photographs.test, [1.0])[0].as_dict()
            rows.append(row | {"virtual_scale": s, "kept_share": row["kept"] / len(self.base.gaussians)})
            seconds.append(merging + tuned.seconds)
        return seconds, rows

    def counts(self) -> list[int]:
        """What ours keeps at each dial value in its longest run."""
        ours = [r for r in stored(self.scene, self.max_sv) if r["method"] == "ours"]
        if not ours:
            sys.exit(f"the specialists need to know what ours keeps: run --methods ours on {self.scene} first")
        longest = max(reversed(ours), key=lambda r: r["iters"])  # of equal ones the last
        return [round(row["kept"]) for row in longest["rows"]]

    def watched(self, label: str, work: Callable[[Callable[[float], None]], Any]) -> Any:
        with self.console.meter(f"{self.scene}, {label}") as meter:
            return work(meter.update)


def stored(scene: str, max_sv: float) -> list[dict[str, Any]]:
    return [row for row in stored_rows(FILE) if (row["scene"], row["max_sv"]) == (scene, max_sv)]


def plot(scene: str, max_sv: float) -> None:
    """A panel a dial value: error against seconds of training, the mean over seeds of the last row of each."""
    rows = list({(r["method"], r["iters"], r["seed"]): r for r in stored(scene, max_sv)}.values())  # the last of each
    if not rows:
        sys.exit(f"there are no rows of {scene} with max_sv {max_sv:g} in {RESULTS / FILE}")
    dials = [row["virtual_scale"] for row in rows[-1]["rows"]]
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    with new_figure((4.6 * len(dials), 4.3), layout="constrained") as figure:
        title = f"{scene}: held-out error against time of training, {rows[-1]['base']['kept']:,.0f} Gaussians"
        figure.suptitle(title, fontsize=11.5, weight="bold", x=0.008, ha="left")
        for k, (axes, s) in enumerate(zip(figure.subplots(1, len(dials), squeeze=False)[0], dials, strict=True)):
            draw_training(axes, lines(curves(rows, k)), rows[-1]["base"]["psnr"])
            axes.set_title(f"s = {s:g}", loc="left", fontsize=10, weight="bold")
        save_figure(figure, PICTURE)
    write(scene, max_sv, rows, dials)
    print(f"{PICTURE}\n{PAGE}")


def write(scene: str, max_sv: float, rows: list[dict[str, Any]], dials: list[float]) -> None:
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
    facts = rows[-1]["machine"] | {"max_sv": max_sv, "command": f"python benchmarks/tradeoff.py {scene}"}
    facts["commits"] = ", ".join(sorted({row["commit"] for row in rows}))
    body.append(page.section("What it was run with", page.facts(facts)))
    page.write_page(PAGE, "Held-out error against seconds of training", "clod-adapter, benchmark", body, {"rows": rows})


def curves(rows: Sequence[dict[str, Any]], k: int) -> dict[str, list[tuple[float, float, float]]]:
    """The curve of each method that has one, by its label."""
    found = {label: curve([r for r in rows if r["method"] == method], k) for method, label in LABELS.items()}
    return {label: points for label, points in found.items() if points}


def lines(found: dict[str, list[tuple[float, float, float]]]) -> list[dict[str, Any]]:
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


def curve(rows: Sequence[dict[str, Any]], k: int) -> list[tuple[float, float, float]]:
    """(seconds, PSNR, share kept) a budget, at the k-th dial value."""
    found = []
    for iters in sorted({row["iters"] for row in rows}):
        runs = [row for row in rows if row["iters"] == iters]
        each = [(run["seconds"][k], run["rows"][k]["psnr"], run["rows"][k]["kept_share"]) for run in runs]
        found.append(tuple(fmean(column) for column in zip(*each, strict=True)))
    return found


if __name__ == "__main__":
    main()
