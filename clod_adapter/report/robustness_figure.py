"""The figure of the robustness experiment: quality against count, distributions of opacity and sigma_d."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clod_adapter.report.style import INK, ORANGE, QUIET, label_log, new_figure, save_figure, shades, tidy

PANELS = ("PSNR (dB)", "SSIM", "opacity", "decay sigma_d (log scale)")


def robustness_figure(path: str | Path, cells: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draws four panels per checkpoint: PSNR and SSIM against Gaussians kept, opacity, sigma_d.

    ``cells`` are those of the experiment's JSON, of which some may be missing; a baseline's ``max_sv`` is None.
    """
    names = list(dict.fromkeys(cell["checkpoint"] for cell in cells))
    ranges = sorted({cell["max_sv"] for cell in cells if cell["max_sv"] is not None})
    colours = dict(zip(ranges, shades(len(ranges)), strict=True))
    with new_figure((13.2, 0.95 + 3.0 * len(names)), layout="constrained") as figure:
        figure.suptitle(title, fontsize=11.5, weight="bold", x=0.008, ha="left")
        grid = figure.subplots(len(names), 4, squeeze=False, width_ratios=[1.35, 1.35, 1, 1])
        for axes, name in zip(grid, names, strict=True):
            group = [cell for cell in cells if cell["checkpoint"] == name]
            _quality(axes[0], group, "psnr", colours)
            _quality(axes[1], group, "ssim", colours)
            _distribution(axes[2], group, "opacity", colours)
            _distribution(axes[3], group, "log10_sigma_d", colours)
            axes[0].set_title(name, loc="left", fontsize=10, weight="bold")
            for panel, label in zip(axes[:2], PANELS, strict=False):
                panel.set_ylabel(label)
        for panel, label in zip(grid[-1], ("Gaussians kept (log scale)",) * 2 + PANELS[2:], strict=True):
            panel.set_xlabel(label)
        _legend(figure, colours)
        save_figure(figure, path)


def _quality(axes: Any, cells: Sequence[Mapping[str, Any]], key: str, colours: Mapping[float, str]) -> None:
    axes.set_xscale("log")
    for cell in cells:
        points = sorted((row["kept"], row[key], row["virtual_scale"]) for row in cell["rows"] if row[key] is not None)
        if cell["max_sv"] is None:
            _plot(axes, points, "--", color=ORANGE, linewidth=1.4, marker="D", markersize=3, zorder=2)
            continue
        inside = [point for point in points if point[2] <= cell["max_sv"]]
        beyond = [point for point in points if point[2] >= cell["max_sv"]]
        style = {"color": colours[cell["max_sv"]], "marker": "o"}
        _plot(axes, beyond, ":", linewidth=1.2, markersize=3.4, mfc="white", zorder=3, **style)
        _plot(axes, inside, "-", linewidth=1.8, markersize=4.2, zorder=4, **style)
    axes.margins(x=0.06, y=0.12)
    label_log(axes.xaxis)
    tidy(axes)


def _plot(axes: Any, points: Sequence[tuple[float, ...]], line: str, **style: Any) -> None:
    axes.plot([point[0] for point in points], [point[1] for point in points], line, **style)


def _distribution(axes: Any, cells: Sequence[Mapping[str, Any]], key: str, colours: Mapping[float, str]) -> None:
    """Outlines of the histograms, in percent of the Gaussians per bin."""
    for cell in cells:
        if histogram := cell["distribution"].get(key):
            heights, base = [100 * share for share in histogram["shares"]], cell["max_sv"] is None
            style = {"color": ORANGE, "linestyle": "--"} if base else {"color": colours[cell["max_sv"]]}
            axes.stairs(heights, histogram["edges"], linewidth=1.4, **style)
    axes.set_ylabel("% of Gaussians per bin", color=QUIET, fontsize=8)
    if key == "opacity":
        axes.set_yscale("log")  # most are nearly transparent
        label_log(axes.yaxis, "{:g}")
    else:
        axes.set_ylim(bottom=0)
        _trim(axes, [cell["distribution"][key] for cell in cells if key in cell["distribution"]])
    tidy(axes)


def _trim(axes: Any, histograms: Sequence[Mapping[str, Any]]) -> None:
    """Limits the axis to the decades of sigma_d whose bins hold a thousandth of the Gaussians or more."""
    used = [k for h in histograms for k, share in enumerate(h["shares"]) if share > 1e-3]
    if used:
        edges = histograms[0]["edges"]
        low, high = math.floor(edges[min(used)]), math.ceil(edges[max(used) + 1])
        axes.set_xlim(low, high)
        axes.set_xticks(range(low, high + 1), [f"{10.0**k:g}" for k in range(low, high + 1)])


def _legend(figure: Any, colours: Mapping[float, str]) -> None:
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], color=ORANGE, linestyle="--", marker="D", markersize=3)]
    names = ["unadapted, pruned by opacity"]
    for max_sv, colour in colours.items():
        lines.append(Line2D([], [], color=colour, linewidth=1.8, marker="o", markersize=4.2))
        names.append("adapted at s = 1 only" if max_sv == 1 else f"adapted, s in [1, {max_sv:g}]")
    lines.append(Line2D([], [], color=INK, linestyle=":", marker="o", markersize=3.4, mfc="white"))
    names.append("beyond the trained range")
    figure.legend(lines, names, loc="outside lower left", ncols=len(names), frameon=False, fontsize=8.5)
