"""The common style of figures, and charts of error against the number of Gaussians, rendering time
and adapting time, as PNG or SVG.

Their series are rows that ``clod-adapt --json`` and ``clod-adapt eval --json`` print. matplotlib is
an optional dependency, imported when a figure is drawn.
"""

import importlib.util
import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from clod_adapter._support.text import package_version
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path

INK = "#1c1c1e"
QUIET = "#6b6b70"
GRID = "#e4e4e7"
PAPER = "#ffffff"
BLUE = "#1f5fa8"
ORANGE = "#c2571a"
GREEN = "#2d7d5a"
PURPLE = "#7a4fa3"
SERIES = (BLUE, ORANGE, GREEN, PURPLE, QUIET)  # in the order that lines are drawn
DPI = 200
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # included in matplotlib, so text has the same size everywhere
    "text.color": INK,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "font.size": 9,
    "text.parse_math": False,  # names of files may have a $
    "svg.fonttype": "none",  # keeps text as text in a page
}
Draw = Callable[[Any], None]  # of the axes of an empty figure
SIZE = (7.2, 4.1)  # inches, without the legend
NARROW = (4.0, 4.0)  # likewise, for phones
MARGINS = (0.75, 0.5, 0.65, 0.1)  # left, bottom, right and top of the axes, inches
COLUMN = 2.4  # width of a column of the legend, inches
LINE = 0.19  # height of a line of the legend, inches
MARKERS = "oDs^vPX"
ROOM = (38, 11)  # points that a label takes
# steps of a decade, the coarsest series first
TICK_SERIES: tuple[Sequence[float], ...] = (
    (1,),
    (1, 2, 5),
    (1, 1.5, 2, 3, 4, 5, 7),
    tuple(k / 10 for k in range(10, 100)),
)
FEWEST_TICKS = 3
MOST_TICKS = 9
BASE = "base, unadapted"


@dataclass(frozen=True)
class Series:
    """Rows of one file or baseline; ``dial``: they are one file at several dial values."""

    label: str
    rows: Sequence[Mapping[str, Any]]
    dial: bool = False


def series_of(report: Mapping[str, Any]) -> list[Series]:
    """The series of a report: the model at its dial values first, then the measured comparisons.

    Keys: ``rows``; ``base_row`` or ``base_rows``, the unadapted base; ``detached_row``, the file
    without its dial; ``ranked``, ``[{by, row}]``, the base pruned by rank; ``against``,
    ``[{label, theirs}]``, other files. Rows without a PSNR (null in JSON if infinite) are skipped.
    """
    base: list[Any] = report.get("base_rows") or [report.get("base_row")]
    plain_model = report.get("attenuation", {}) is None  # evaluation of a file without a dial
    model = Series(
        "the file, no dial" if plain_model else "dial, one file",
        report.get("rows", []),
        not plain_model,
    )
    others = dict[tuple[str, bool], Any]()  # by label, and whether several rows are of one file
    for entry in report.get("ranked") or []:
        others.setdefault((f"base pruned by {entry['by']}", False), []).append(entry["row"])
    for entry in report.get("against") or []:
        others.setdefault((entry["label"], True), []).append(entry["theirs"])
    all_series = [model, Series(BASE, base)]
    all_series += [
        Series(label, rows, one_file and len(rows) > 1)
        for (label, one_file), rows in others.items()
    ]
    all_series.append(Series("plain viewer, no dial", [report.get("detached_row") or {}]))
    complete = []
    for series in all_series:
        rows = [row for row in series.rows if row and row["psnr"] is not None]
        if rows:
            complete.append(replace(series, rows=rows))
    return complete


def chart_file(page: Path, name: str) -> Path:
    """Path of a page's chart, in the folder of the page."""
    return page.with_name(f"{page.stem}_{name}.png")


@contextmanager
def chart(draw: Draw, size: tuple[float, float]) -> Iterator[Any]:
    """A figure with the chart in fixed margins, whose layout takes no time; higher than ``size`` by
    the legend.
    """
    (left, bottom, right, top), (width, height) = MARGINS, size
    with new_figure(size) as figure:
        axes = figure.add_subplot()
        draw(axes)
        lines = math.ceil(len(axes.get_legend().get_texts()) / _columns(axes))
        above = top + LINE * lines
        figure.set_size_inches(width, height + above)
        axes.set_position(
            (
                left / width,
                bottom / (height + above),
                1 - (left + right) / width,
                (height - bottom) / (height + above),
            )
        )
        yield figure


def _columns(axes: Any) -> int:
    """The number of columns of a legend that have room."""
    return max(int(axes.figure.get_size_inches()[0] / COLUMN), 1)


def inline_svg(draw: Draw, name: str, label: str) -> list[str]:
    """The chart as SVG elements for desktops and phones, in the colours of ``style.css``, with ids
    by its name.
    """
    names = {INK: "ink", QUIET: "quiet", GRID: "line", PAPER: "paper"}
    names |= {colour: f"series-{k + 1}" for k, colour in enumerate(SERIES[:-1])}
    charts = []
    for kind, size in (("wide", SIZE), ("narrow", NARROW)):
        with chart(draw, size) as figure:
            text = io.StringIO()
            figure.savefig(
                text, format="svg", transparent=True, metadata={"Date": None, "Creator": None}
            )
        svg = text.getvalue()[text.getvalue().index("<svg") :]
        for colour, variable in names.items():
            svg = svg.replace(colour, f"var(--{variable})")
        head = rf'<svg class="{kind}" viewBox="\1" role="img" aria-label="{label}">'
        svg = re.sub(r'^<svg [^>]*?viewBox="([^"]*)"[^>]*>', head, svg)
        svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S).replace("xlink:href", "href")
        svg = re.sub(r'( id="|"#|url\(#)', rf"\g<1>{name}-{kind}-", svg)
        charts.append(svg.replace("'DejaVu Sans'", "ui-sans-serif, system-ui, sans-serif"))
    return charts


# by the name of the chart: the value of a row, the unit of the axis, its label
QUANTITIES = {
    "rendering": ("frame_ms", 1, "milliseconds per frame (log scale)"),
    "count": ("kept", 1000, "Gaussians drawn, thousands (log scale)"),
}


def draw_rows(axes: Any, series: Sequence[Series], quantity: str) -> None:
    """Draws error against one of QUANTITIES: lines for files with a dial, points for others."""
    key, unit, label = QUANTITIES[quantity]
    notes = list[tuple[str, tuple[float, float]]]()
    for k, line in enumerate(series):
        rows = [row for row in line.rows if row[key] > 0]  # a log axis has no 0
        if not rows:
            continue
        points = [(row[key] / unit, row["psnr"]) for row in rows]
        _line(axes, k, line.label, points, linestyle="-" if line.dial else "none")
        if line.dial:
            texts = [f"s = {row['virtual_scale']:g}" for row in rows]
            notes += zip(texts, points, strict=True)
    _finish(axes, label)
    # Labels of points, without those that would cover another; the first and the last come first.
    point = axes.figure.dpi / 72
    placed = list[Any]()
    for text, at in sorted(notes, key=lambda note: note not in (notes[0], notes[-1])):
        x, y = axes.transData.transform(at) / point
        if all(abs(x - left) > ROOM[0] or abs(y - low) > ROOM[1] for left, low in placed):
            placed.append((x, y))
            axes.annotate(
                text, at, (-5, -11), textcoords="offset points", ha="right", fontsize=8, color=QUIET
            )


def draw_training(axes: Any, curves: Sequence[Mapping[str, Any]], base_psnr: float | None) -> None:
    """Draws held-out error against seconds of adapting, and that of the unadapted base as a
    horizontal line.
    """
    for k, curve in enumerate(curves):
        points = [(point["seconds"], point["psnr"]) for point in curve["points"]]
        _line(axes, k, curve["label"], points)
    if base_psnr is not None:
        axes.axhline(base_psnr, color=INK, linestyle="--", linewidth=1.1, label=BASE)
    _finish(axes, "seconds of adapting (log scale)")


def _line(
    axes: Any, k: int, label: str, points: Sequence[tuple[float, float]], linestyle: str = "-"
) -> None:
    style = {
        "color": SERIES[k % len(SERIES)],
        "marker": MARKERS[k % len(MARKERS)],
        "linestyle": linestyle,
    }
    axes.plot(*zip(*points, strict=True), linewidth=1.8, markersize=5.5, label=label, **style)


def error(psnr: float) -> float:
    """Mean squared error of colours in [0, 1] for a PSNR in dB."""
    return 10.0 ** (-psnr / 10)


def _finish(axes: Any, label: str) -> None:
    """Axes of an error chart: PSNR downwards, which is the logarithm of the error; labels of both
    at the same ticks.
    """
    axes.set_xscale("log")
    axes.set_xlabel(label)
    axes.margins(x=0.2, y=0.12)
    axes.invert_yaxis()
    axes.secondary_yaxis("right").set_ylabel("PSNR (dB)")
    axes.set_ylabel("mean squared error, thousandths (log scale)")
    axes.set_yticks(_round_errors(*axes.get_ylim()))
    axes.yaxis.set_major_formatter(lambda psnr, _: f"{1e3 * error(psnr):.3g}")
    near, far = axes.get_xlim()
    subs = TICK_SERIES[1] if far / near > 20 else TICK_SERIES[2]
    label_log(axes.xaxis, "{:,g}", subs)
    # above the axes it covers nothing
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=_columns(axes), borderaxespad=0)
    axes.annotate(
        "better", (0.012, 0.018), xycoords="axes fraction", fontsize=8, color=QUIET, style="italic"
    )


def _round_errors(low: float, high: float) -> list[float]:
    """The PSNR of round errors: of the coarsest series of steps with FEWEST_TICKS in the range."""
    low, high = sorted((low, high))
    decades = range(math.floor(-high / 10), math.ceil(-low / 10) + 1)
    ticks = list[float]()
    for steps in TICK_SERIES:
        every = (-10 * math.log10(step) - 10 * decade for decade, step in product(decades, steps))
        ticks = [psnr for psnr in every if low <= psnr <= high]
        if len(ticks) >= FEWEST_TICKS:
            break
    return ticks[:: max(math.ceil(len(ticks) / MOST_TICKS), 1)]


def check_matplotlib() -> None:
    """Raises ClodError if matplotlib is missing, for a check before long work."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ClodError("pictures need matplotlib: pip install matplotlib")


@contextmanager
def new_figure(inches: tuple[float, float], **options: Any) -> Iterator[Any]:
    """A matplotlib figure in the common style; without pyplot, so a notebook's figures are not
    affected.
    """
    check_matplotlib()
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        yield Figure(figsize=inches, dpi=DPI, facecolor=PAPER, **options)


def save_figure(figure: Any, path: str | Path) -> None:
    # Text in a PNG by which a later run recognizes its own output.
    about = None
    if Path(path).suffix.lower() == ".png":
        about = {"Software": f"clod-adapter {package_version()}"}
    with atomic_path(path) as temporary:
        figure.savefig(temporary, facecolor=PAPER, metadata=about)


def label_log(axis: Any, text: str = "{:,.0f}", subs: Sequence[float] = (1, 2, 5)) -> None:
    """Labels at round numbers of a log axis, ``subs`` in each decade, written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: text.format(value)))
    axis.set_minor_formatter(NullFormatter())
