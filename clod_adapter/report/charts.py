"""The common style of figures, and charts of error against the number of Gaussians, rendering time
and adapting time, as PNG or SVG.

Their series are rows that ``clod-adapt --json`` and ``clod-adapt eval --json`` print. matplotlib is
an optional dependency, imported when a figure is drawn.
"""

import importlib.util
import io
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
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
SIZE = (7.2, 4.8)  # inches
MARKERS = "oDs^vPX"
APART = 1.3  # ratio of dial values that are labelled; closer ones could overlap
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
    pruned = defaultdict[str, list[Any]](list)
    for entry in report.get("ranked") or []:
        pruned[f"base pruned by {entry['by']}"].append(entry["row"])
    files = defaultdict[str, list[Any]](list)
    for entry in report.get("against") or []:
        files[entry["label"]].append(entry["theirs"])
    all_series = [model, Series(BASE, base)]
    all_series += [Series(label, rows) for label, rows in pruned.items()]
    all_series += [Series(label, rows, len(rows) > 1) for label, rows in files.items()]
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
def chart(draw: Draw) -> Iterator[Any]:
    """A figure with the chart."""
    with new_figure(SIZE, layout="constrained") as figure:
        draw(figure.subplots())
        yield figure


def inline_svg(draw: Draw, name: str, label: str) -> str:
    """The chart as an SVG element, in the colours of ``style.css``, with ids by its name."""
    names = {INK: "ink", QUIET: "quiet", GRID: "line", PAPER: "paper"}
    names |= {colour: f"series-{k + 1}" for k, colour in enumerate(SERIES[:-1])}
    with chart(draw) as figure:
        file = io.StringIO()
        undated = {"Date": None, "Creator": None}
        figure.savefig(file, format="svg", transparent=True, metadata=undated)
    text = file.getvalue()
    svg = text[text.index("<svg") :]
    for colour, variable in names.items():
        svg = svg.replace(colour, f"var(--{variable})")
    head = rf'<svg viewBox="\1" role="img" aria-label="{label}">'
    svg = re.sub(r'^<svg [^>]*?viewBox="([^"]*)"[^>]*>', head, svg)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S).replace("xlink:href", "href")
    svg = re.sub(r'( id="|"#|url\(#)', rf"\g<1>{name}-", svg)
    return svg.replace("'DejaVu Sans'", "ui-sans-serif, system-ui, sans-serif")


# by the name of the chart: the value of a row, the unit of the axis, its label
QUANTITIES = {
    "rendering": ("frame_ms", 1, "milliseconds per frame (log scale)"),
    "count": ("kept", 1000, "Gaussians drawn, thousands (log scale)"),
}


def draw_rows(axes: Any, series: Sequence[Series], quantity: str) -> None:
    """Draws error against one of QUANTITIES: lines for files with a dial, points for others."""
    key, unit, label = QUANTITIES[quantity]
    for k, line in enumerate(series):
        rows = [row for row in line.rows if row[key] > 0]  # a log axis has no 0
        if not rows:
            continue
        points = [(row[key] / unit, error(row["psnr"])) for row in rows]
        _line(axes, k, line.label, points, linestyle="-" if line.dial else "none")
        if line.dial:
            _label(axes, [row["virtual_scale"] for row in rows], points)
    _finish(axes, label)


def _label(axes: Any, dials: Sequence[float], points: Sequence[tuple[float, float]]) -> None:
    """Labels points with their dial values, except those close to the last labelled one."""
    last = 0.0
    for s, point in sorted(zip(dials, points, strict=True)):
        if s >= APART * last:
            last = s
            offset = {"xytext": (-5, -11), "textcoords": "offset points", "ha": "right"}
            axes.annotate(f"s = {s:g}", point, fontsize=8, color=QUIET, **offset)


def draw_training(axes: Any, curves: Sequence[Mapping[str, Any]], base_psnr: float | None) -> None:
    """Draws held-out error against seconds of adapting, and that of the unadapted base as a
    horizontal line.
    """
    for k, curve in enumerate(curves):
        points = [(point["seconds"], error(point["psnr"])) for point in curve["points"]]
        _line(axes, k, curve["label"], points)
    if base_psnr is not None:
        axes.axhline(error(base_psnr), color=INK, linestyle="--", linewidth=1.1, label=BASE)
    _finish(axes, "seconds of adapting (log scale)")


def _line(
    axes: Any,
    k: int,
    label: str,
    points: Sequence[tuple[float, float]],
    linestyle: str = "-",
) -> None:
    colour = SERIES[k % len(SERIES)]
    marker = MARKERS[k % len(MARKERS)]
    axes.plot(
        *zip(*points, strict=True),
        color=colour,
        marker=marker,
        linestyle=linestyle,
        linewidth=1.8,
        markersize=5.5,
        label=label,
    )


def error(psnr: Any) -> Any:
    """Mean squared error of colours in [0, 1], in thousandths, for a PSNR in dB."""
    return 1e3 * 10.0 ** (-psnr / 10)


def psnr_of(thousandths: Any) -> Any:
    """The inverse of ``error``."""
    import numpy as np  # here: --help needs none

    return 30 - 10 * np.log10(thousandths)


def _finish(axes: Any, label: str) -> None:
    """Log axes, PSNR on the right, and the legend above them, where it covers nothing."""
    from matplotlib.ticker import AutoLocator, ScalarFormatter

    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(label)
    axes.set_ylabel("mean squared error, thousandths (log scale)")
    axes.margins(x=0.2, y=0.12)
    label_log(axes.xaxis, "{:,g}")
    label_log(axes.yaxis, "{:,g}")
    right = axes.secondary_yaxis("right", functions=(psnr_of, error))
    right.set_ylabel("PSNR (dB)")
    right.yaxis.set_major_locator(AutoLocator())
    right.yaxis.set_major_formatter(ScalarFormatter())
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0)
    axes.annotate(
        "better",
        (0.012, 0.018),
        xycoords="axes fraction",
        fontsize=8,
        color=QUIET,
        style="italic",
    )


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
    """Writes a PNG, with text by which a later run recognizes its own output."""
    about = {"Software": f"clod-adapter {package_version()}"}
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", facecolor=PAPER, metadata=about)


def label_log(axis: Any, text: str = "{:,.0f}", subs: Sequence[float] = (1, 2, 5)) -> None:
    """Labels at round numbers of a log axis, ``subs`` in each decade, written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: text.format(value)))
    axis.set_minor_formatter(NullFormatter())
