"""Charts of error against rendering time and adapting time, on log axes, as PNG or as SVG in the page's colours."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from clod_adapter.report.series import Series
from clod_adapter.report.style import GRID, INK, PAPER, QUIET, SERIES, label_log, new_figure, save_figure

Draw = Callable[[Any], None]
SIZE = (7.2, 4.1)  # inches
STEPS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # dB between grid lines
MARKERS = "oDs^vPX"


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


def inline_svg(draw: Draw, label: str) -> str:
    """The chart as an SVG element with the colours of ``style.css`` (``--ink``, ``--series-1``, ...)."""
    with new_figure(SIZE, layout="constrained") as figure:
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = text.getvalue()[text.getvalue().index("<svg") :]
    names = {INK: "ink", QUIET: "quiet", GRID: "line", PAPER: "paper"}
    names |= {colour: f"series-{k + 1}" for k, colour in enumerate(SERIES[:-1])}
    for colour, name in names.items():
        svg = svg.replace(colour, f"var(--{name})")
    svg = re.sub(r'^<svg [^>]*?viewBox="([^"]*)"[^>]*>', rf'<svg viewBox="\1" role="img" aria-label="{label}">', svg)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = svg.replace("xlink:href", "href")
    return svg.replace("'DejaVu Sans'", "ui-sans-serif, system-ui, sans-serif")


def rendering_chart(series: Sequence[Series]) -> Draw:
    """Error against milliseconds per frame: lines for files with a dial, points for others."""

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for k, one in enumerate(series):
            style = {"color": SERIES[k % len(SERIES)], "marker": MARKERS[k % len(MARKERS)], "label": one.label}
            points = [(row["frame_ms"], error(row["psnr"])) for row in one.rows]
            style["linestyle"] = "-" if one.dial else "none"
            axes.plot(*zip(*points, strict=True), markersize=5.5, linewidth=1.8, **style)
            for row, point in zip(one.rows if one.dial else (), points, strict=False):
                _note(axes, f"s = {row['virtual_scale']:g}", point)
        axes.set_xscale("log")
        axes.set_xlabel("milliseconds per frame (log scale)")
        finish_axes(axes)

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


def _note(axes: Any, text: str, at: tuple[float, float]) -> None:
    axes.annotate(text, at, (-5, -11), textcoords="offset points", ha="right", fontsize=8, color=QUIET)


def finish_axes(axes: Any) -> None:
    """Axes of an error chart: log error on the left, with ticks at round PSNR values, which are on the right."""
    axes.set_yscale("log")
    axes.margins(x=0.09, y=0.12)
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
