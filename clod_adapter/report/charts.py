"""Charts of error against rendering time and adapting time, on log axes, as PNG or as SVG in the page's colours.

Their series are rows that ``clod-adapt --json`` and ``clod-adapt eval --json`` print.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clod_adapter.report.style import GRID, INK, PAPER, QUIET, SERIES, label_log, new_figure, save_figure

Draw = Callable[[Any], None]
SIZE, NARROW = (7.2, 4.1), (4.0, 4.0)  # inches; NARROW for phones
STEPS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # dB between grid lines
MARKERS = "oDs^vPX"
ROOM = (38, 11)  # points that a label takes


@dataclass(frozen=True)
class Series:
    """Rows of one file or baseline.

    Attributes:
        rows: each with psnr, ssim, kept, frame_ms, and for a dial virtual_scale.
        dial: whether the rows are one file at several dial values.
    """

    label: str
    rows: Sequence[Mapping[str, Any]]
    dial: bool = False

    @property
    def is_base(self) -> bool:
        return self.label.startswith("base, ")


def series_of(report: Mapping[str, Any]) -> list[Series]:
    """The series of a report: the model at its dial values first, then the measured comparisons.

    Keys: ``rows``; ``base_row`` or ``base_rows``, the unadapted base; ``detached_row``, the file without its dial;
    ``ranked``, ``[{by, row}]``, the base pruned by rank; ``against``, ``[{model, label, theirs}]``, other files. Rows
    without a PSNR (null in JSON if infinite) are skipped.
    """
    base: list[Any] = report.get("base_rows") or [report.get("base_row")]
    plain_model = report.get("attenuation", {}) is None  # evaluation of a file without a dial
    model = Series("the file, no dial" if plain_model else "dial, one file", report.get("rows", []), not plain_model)
    found = [model, Series("base, unadapted", base)]
    ranked = report.get("ranked") or []
    for by in dict.fromkeys(entry["by"] for entry in ranked):
        found.append(Series(f"base pruned by {by}", [entry["row"] for entry in ranked if entry["by"] == by]))
    against = report.get("against") or []
    for path in dict.fromkeys(entry["model"] for entry in against):
        rows = [entry["theirs"] for entry in against if entry["model"] == path]
        label = next(entry["label"] for entry in against if entry["model"] == path)
        found.append(Series(label, rows, dial=len(rows) > 1))
    plain: list[Any] = [report.get("detached_row")]
    found.append(Series("plain viewer, no dial", plain))
    complete = [Series(s.label, [r for r in s.rows if r and r["psnr"] is not None], s.dial) for s in found]
    return [series for series in complete if series.rows]


def write_chart(path: str | Path, draw: Draw) -> None:
    """Draws a chart into a PNG file.

    Raises:
        ClodError: matplotlib is missing, or the file cannot be written.
    """
    with new_figure(SIZE, layout="constrained") as figure:
        draw(figure)
        save_figure(figure, path)


def chart_file(page: Path, name: str) -> Path:
    """Path of a page's chart, in the folder of the page."""
    return page.with_name(f"{page.stem}_{name}.png")


def inline_svg(draw: Draw, name: str, label: str) -> list[str]:
    """The chart as two SVG elements, for desktops and phones, with the colours of ``style.css`` (``--ink``, ...).

    Args:
        name: of the chart in its page, so that ids differ.
    """
    names = {INK: "ink", QUIET: "quiet", GRID: "line", PAPER: "paper"}
    names |= {colour: f"series-{k + 1}" for k, colour in enumerate(SERIES[:-1])}
    found = []
    for kind, size in (("wide", SIZE), ("narrow", NARROW)):
        with new_figure(size, layout="constrained") as figure:
            draw(figure)
            text = io.StringIO()
            figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
        svg = text.getvalue()[text.getvalue().index("<svg") :]
        for colour, variable in names.items():
            svg = svg.replace(colour, f"var(--{variable})")
        head = rf'<svg class="{kind}" viewBox="\1" role="img" aria-label="{label}">'
        svg = re.sub(r'^<svg [^>]*?viewBox="([^"]*)"[^>]*>', head, svg)
        svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S).replace("xlink:href", "href")
        svg = re.sub(r'( id="|"#|url\(#)', rf"\g<1>{name}-{kind}-", svg)
        found.append(svg.replace("'DejaVu Sans'", "ui-sans-serif, system-ui, sans-serif"))
    return found


def rendering_chart(series: Sequence[Series]) -> Draw:
    """Error against milliseconds per frame: lines for files with a dial, points for others."""

    def draw(figure: Any) -> None:
        axes, notes = figure.subplots(), list[tuple[str, tuple[float, float]]]()
        for k, one in enumerate(series):
            style = {"color": SERIES[k % len(SERIES)], "marker": MARKERS[k % len(MARKERS)], "label": one.label}
            points = [(row["frame_ms"], error(row["psnr"])) for row in one.rows]
            style["linestyle"] = "-" if one.dial else "none"
            axes.plot(*zip(*points, strict=True), markersize=5.5, linewidth=1.8, **style)
            if one.dial:
                notes += [(f"s = {row['virtual_scale']:g}", at) for row, at in zip(one.rows, points, strict=True)]
        axes.set_xscale("log")
        axes.set_xlabel("milliseconds per frame (log scale)")
        finish_axes(axes)
        _annotate(axes, notes)

    return draw


def training_chart(curves: Sequence[Mapping[str, Any]], base_psnr: float | None) -> Draw:
    """Held-out error against seconds of adapting.

    Args:
        curves: each with ``label`` and ``points``; a point has ``seconds`` and ``psnr``.
        base_psnr: of the unadapted base, drawn as a horizontal line.
    """

    return lambda figure: draw_training(figure.subplots(), curves, base_psnr)


def draw_training(axes: Any, curves: Sequence[Mapping[str, Any]], base_psnr: float | None) -> None:
    """Draws ``training_chart`` into one panel of a figure."""
    for k, curve in enumerate(curves):
        points = [(point["seconds"], error(point["psnr"])) for point in curve["points"]]
        style = {"color": SERIES[k % len(SERIES)], "marker": MARKERS[k % len(MARKERS)], "label": curve["label"]}
        axes.plot(*zip(*points, strict=True), linewidth=1.8, markersize=5, **style)
    if base_psnr is not None:
        axes.axhline(error(base_psnr), color=INK, linestyle="--", linewidth=1.1, label="base, unadapted")
    axes.set_xscale("log")
    axes.set_xlabel("seconds of adapting (log scale)")
    finish_axes(axes)


def error(psnr: float) -> float:
    """Mean squared error of colours in [0, 1] for a PSNR in dB."""
    return 10.0 ** (-psnr / 10)


def _annotate(axes: Any, notes: Sequence[tuple[str, tuple[float, float]]]) -> None:
    """Labels of points, without those that would cover another; the first and the last come first."""
    axes.figure.draw_without_rendering()  # so that the positions are those of the layout
    unit, placed = axes.figure.dpi / 72, list[Any]()
    for text, at in sorted(notes, key=lambda note: note not in (notes[0], notes[-1])):
        x, y = axes.transData.transform(at) / unit
        if all(abs(x - other[0]) > ROOM[0] or abs(y - other[1]) > ROOM[1] for other in placed):
            placed.append((x, y))
            axes.annotate(text, at, (-5, -11), textcoords="offset points", ha="right", fontsize=8, color=QUIET)


def finish_axes(axes: Any) -> None:
    """Axes of an error chart: log error on the left, with ticks at round PSNR values, which are on the right."""
    axes.set_yscale("log")
    axes.margins(x=0.2, y=0.12)
    low, high = (-10 * math.log10(value) for value in reversed(axes.get_ylim()))
    step = next((s for s in STEPS if (high - low) / s <= 8.5), STEPS[-1])
    values = [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
    right = axes.twinx()
    right.set_yscale("log")
    right.set_ylim(axes.get_ylim())
    errors = [error(value) for value in values]
    for side, texts in ((axes, [f"{1e3 * e:.3g}" for e in errors]), (right, [f"{v:.4g}" for v in values])):
        side.set_yticks(errors, texts)
        side.set_yticks([], minor=True)
        side.spines["top"].set_visible(False)
        side.tick_params(length=0)
    axes.set_ylabel("mean squared error, thousandths (log scale)")
    right.set_ylabel("PSNR (dB)")
    left, far = axes.get_xlim()
    label_log(axes.xaxis, "{:,g}", (1, 2, 5) if far / left > 20 else (1, 1.5, 2, 3, 4, 5, 7))
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.legend(frameon=False, fontsize=8.5, loc="best")
    axes.annotate("better", (0.012, 0.018), xycoords="axes fraction", fontsize=8, color=QUIET, style="italic")
