"""The figure of the robustness experiment: quality against count, distributions of opacity and
sigma_d.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from clod_adapter.report.charts import ORANGE, QUIET, label_log, new_figure, save_figure

PANELS = ("PSNR (dB)", "SSIM", "opacity", "reach sigma_d (log scale)")
BEYOND = "beyond the trained range"
Styles = dict[float | None, dict[str, Any]]  # of lines, by the cells' ``max_sv``


def robustness_figure(path: str | Path, cells: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draws four panels per checkpoint: PSNR and SSIM against Gaussians kept, opacity, sigma_d.

    ``cells`` are those of the experiment's JSON, of which some may be missing; a baseline's
    ``max_sv`` is None.
    """
    names = list(dict.fromkeys(cell["checkpoint"] for cell in cells))
    ranges = sorted({cell["max_sv"] for cell in cells if cell["max_sv"] is not None})
    with new_figure((13.2, 0.95 + 3.0 * len(names)), layout="constrained") as figure:
        import matplotlib

        styles: Styles = {None: {"color": ORANGE, "linestyle": "--"}}
        for k, max_sv in enumerate(ranges, 1):
            colour = matplotlib.colormaps["Blues"](0.4 + 0.6 * k / len(ranges))
            styles[max_sv] = {"color": colour}
        figure.suptitle(title, fontsize=11.5, weight="bold", x=0.008, ha="left")
        grid = figure.subplots(len(names), 4, squeeze=False, width_ratios=[1.35, 1.35, 1, 1])
        for axes, name in zip(grid, names, strict=True):
            group = [cell for cell in cells if cell["checkpoint"] == name]
            _quality(axes[0], group, "psnr", styles)
            _quality(axes[1], group, "ssim", styles)
            _distribution(axes[2], group, "opacity", styles)
            _distribution(axes[3], group, "log10_sigma_d", styles)
            axes[0].set_title(name, loc="left", fontsize=10, weight="bold")
            for panel, label in zip(axes[:2], PANELS, strict=False):
                panel.set_ylabel(label)
        labels = ["Gaussians kept (log scale)"] * 2 + [*PANELS[2:]]
        for panel, label in zip(grid[-1], labels, strict=True):
            panel.set_xlabel(label)
        lines = dict[str, Any]()
        for axes in grid[:, 0]:
            lines |= {line.get_label(): line for line in axes.get_lines()}
        labels = sorted(lines, key=lambda label: label == BEYOND)
        figure.legend(
            [lines[label] for label in labels], labels, loc="outside lower left", ncols=len(labels)
        )
        save_figure(figure, path)


def _quality(axes: Any, cells: Sequence[Mapping[str, Any]], key: str, styles: Styles) -> None:
    axes.set_xscale("log")
    for cell in cells:
        rows = [row for row in cell["rows"] if row[key] is not None]
        last = cell["max_sv"]
        label = f"adapted, s in [1, {last:g}]" if last and last > 1 else "adapted at s = 1 only"
        style = styles[last] | {"marker": "o", "label": label}
        if last is None:
            style |= {"marker": "D", "label": "unadapted, pruned by opacity"}
        elif outside := [row for row in rows if row["virtual_scale"] >= last]:
            _plot(axes, outside, key, style | {"linestyle": ":", "mfc": "white", "label": BEYOND})
        # On top, as the end of the range is in both.
        inside = [row for row in rows if last is None or row["virtual_scale"] <= last]
        _plot(axes, inside, key, style)
    axes.margins(x=0.06, y=0.12)
    label_log(axes.xaxis)


def _plot(axes: Any, rows: Sequence[Mapping[str, Any]], key: str, style: Mapping[str, Any]) -> None:
    points = sorted((row["kept"], row[key]) for row in rows)
    kept = [x for x, _ in points]
    values = [y for _, y in points]
    axes.plot(kept, values, linewidth=1.5, markersize=4, **style)


def _distribution(axes: Any, cells: Sequence[Mapping[str, Any]], key: str, styles: Styles) -> None:
    """Outlines of the histograms, in percent of the Gaussians per bin."""
    for cell in cells:
        if histogram := cell["distribution"].get(key):
            heights = [100 * share for share in histogram["shares"]]
            axes.stairs(heights, histogram["edges"], linewidth=1.4, **styles[cell["max_sv"]])
    axes.set_ylabel("% of Gaussians per bin", color=QUIET, fontsize=8)
    if key == "opacity":
        axes.set_yscale("log")  # most are nearly transparent
        label_log(axes.yaxis, "{:g}")
        return
    # The decades of sigma_d whose bins hold a thousandth of the Gaussians or more.
    axes.set_ylim(bottom=0)
    used = list[float]()
    for cell in cells:
        if histogram := cell["distribution"].get(key):
            for ends, share in zip(pairwise(histogram["edges"]), histogram["shares"], strict=True):
                used += ends if share > 1e-3 else ()
    if used:
        low = math.floor(min(used))
        high = math.ceil(max(used))
        axes.set_xlim(low, high)
        axes.set_xticks(range(low, high + 1), [f"{10.0**k:g}" for k in range(low, high + 1)])
