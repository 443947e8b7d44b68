"""The figure of the robustness experiment: quality against count, distributions of opacity and
sigma_d.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clod_adapter.report.charts import ORANGE, QUIET, label_log, new_figure, save_figure

BEYOND = "beyond the trained range"
Cells = Sequence[Mapping[str, Any]]
Styles = dict[float | None, dict[str, Any]]  # of lines, by the cells' ``max_sv``


def robustness_figure(path: str | Path, cells: Cells, title: str) -> None:
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
        lines = dict[str, Any]()
        for (psnr, ssim, opacity, sigma), name in zip(grid, names, strict=True):
            group = [cell for cell in cells if cell["checkpoint"] == name]
            psnr.set_title(name, loc="left", fontsize=10, weight="bold")
            _quality(psnr, group, "psnr", styles)
            psnr.set_ylabel("PSNR (dB)")
            _quality(ssim, group, "ssim", styles)
            ssim.set_ylabel("SSIM")
            _distribution(opacity, group, "opacity", styles)
            opacity.set_xlabel("opacity")
            opacity.set_yscale("log")  # most are nearly transparent
            label_log(opacity.yaxis, "{:g}")
            _distribution(sigma, group, "log10_sigma_d", styles)
            sigma.set_xlabel("reach sigma_d (log scale)")
            sigma.xaxis.set_major_formatter(lambda power, _: f"{10.0**power:g}")
            lines |= {line.get_label(): line for line in psnr.get_lines()}
        figure.legend(lines.values(), lines, loc="outside lower left", ncols=len(lines))
        save_figure(figure, path)


def _quality(axes: Any, cells: Cells, key: str, styles: Styles) -> None:
    axes.set_xscale("log")
    axes.set_xlabel("Gaussians kept (log scale)")
    for cell in cells:
        rows = [row for row in cell["rows"] if row[key] is not None]
        last = cell["max_sv"]
        if last is None:
            style = {"marker": "D", "label": "unadapted, pruned by opacity"}
            _plot(axes, rows, key, styles[last] | style)
            continue
        outside = [row for row in rows if row["virtual_scale"] >= last]
        style = {"marker": "o", "mfc": "white", "linestyle": ":", "label": BEYOND}
        _plot(axes, outside, key, styles[last] | style)
        # On top, as the end of the range is in both.
        inside = [row for row in rows if row["virtual_scale"] <= last]
        label = f"adapted, s in [1, {last:g}]" if last > 1 else "adapted at s = 1 only"
        _plot(axes, inside, key, styles[last] | {"marker": "o", "label": label})
    axes.margins(x=0.06, y=0.12)
    label_log(axes.xaxis)


def _plot(axes: Any, rows: Sequence[Mapping[str, Any]], key: str, style: Mapping[str, Any]) -> None:
    points = sorted((row["kept"], row[key]) for row in rows)
    axes.plot(*zip(*points, strict=True), linewidth=1.5, markersize=4, **style)


def _distribution(axes: Any, cells: Cells, key: str, styles: Styles) -> None:
    """Outlines of the histograms, in percent of the Gaussians per bin."""
    for cell in cells:
        if histogram := cell["distribution"].get(key):
            heights = [100 * share for share in histogram["shares"]]
            axes.stairs(heights, histogram["edges"], linewidth=1.4, **styles[cell["max_sv"]])
    axes.set_ylabel("% of Gaussians per bin", color=QUIET, fontsize=8)
