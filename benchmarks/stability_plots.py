"""The pictures of docs/stability.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from clod_adapter.report.style import BLUE, GREEN, INK, ORANGE, QUIET, label_log, new_figure, save_figure, tidy
from stability_popping import STEPS as LENGTHS_OF_STEPS
from stability_popping import SWEEPS, TOGETHER
from stability_stiffness import CONFIG, CONVERGED, LENGTHS, OPTIMIZERS, STEPS, curves

NOTE = {"fontsize": 8, "color": QUIET, "va": "top"}
LEGEND = {"loc": "outside lower center", "frameon": False, "fontsize": 8.5}


def stiffness(rows: list[dict[str, Any]], path: Path) -> None:
    """Error by learning rate on the left, by seconds at the best one on the right; dots for linear sigma."""
    (start,) = (row["error"] for row in rows if row["what"] == "start")
    with new_figure((10.4, 4.6), layout="constrained") as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, timed, along in zip(panels, (False, True), ("rate", "seconds"), strict=True):
            for (optimizer, parameter), own in curves(rows, timed).items():
                ours = (optimizer, parameter) == ("RowAdam", "log")
                axes.plot(
                    [row[along] for row in own], [row["error"] for row in own], color=OPTIMIZERS[optimizer][1],
                    linestyle="-" if parameter == "log" else ":", linewidth=2.6 if ours else 1.3, marker="o",
                    markersize=3.5 if parameter == "log" else 0, zorder=3 if ours else 2,
                    label=optimizer + (" (default)" if ours else "") if parameter == "log" else None,
                )  # fmt: skip
            for y, text in ((start, "start"), (CONVERGED * start, "converged")):
                axes.axhline(y, color=QUIET, linewidth=0.8, linestyle="--")
                if not timed:
                    axes.text(0.01, y * 0.97, text, transform=axes.get_yaxis_transform(), **NOTE)
            axes.set(xscale="log", yscale="log")
            tidy(axes)
        label_log(panels[0].yaxis, "{:g}")
        label_log(panels[0].xaxis, "{:g}", subs=(1,))
        label_log(panels[1].xaxis, "{:g}", subs=(1, 3))
        panels[0].axvline(CONFIG.lr_sigma, color=BLUE, linewidth=0.8)
        panels[0].text(CONFIG.lr_sigma * 0.9, 0.0125, "default\nlearning rate", fontsize=8, color=BLUE, ha="right")
        panels[0].set(ylim=(0.012, 0.6), ylabel="RMS error of the opacity that is drawn")
        panels[0].set_xlabel(f"learning rate, {STEPS} steps")
        panels[1].set_xlabel(f"seconds of training, {LENGTHS[0]} to {LENGTHS[-1]} steps at the best learning rate")
        panels[0].plot([], [], color=INK, linestyle="-", marker="o", markersize=3.5, label="log sigma_d")
        panels[0].plot([], [], color=INK, linestyle=":", label="linear sigma_d")
        figure.legend(*panels[0].get_legend_handles_labels(), **LEGEND, ncols=5)
        save_figure(figure, path)


def popping(rows: list[dict[str, Any]], path: Path) -> None:
    """Log-log, a panel a sweep: a colour a normalizer, dashes for the hard threshold; without growth."""
    rows = [row for row in rows if not row["growth"]]
    colours = {"scene": BLUE, "quantile": GREEN, "max": ORANGE}
    with new_figure((10.4, 3.9), layout="constrained") as figure:
        panels = figure.subplots(1, len(SWEEPS), sharey=True)
        for axes, (sweep, title) in zip(panels, SWEEPS.items(), strict=True):
            for normalizer, cut in dict.fromkeys((row["normalizer"], row["cut"]) for row in rows):
                own = [r for r in rows if (r["normalizer"], r["cut"], r["sweep"]) == (normalizer, cut, sweep)]
                if sweep == "dial" and normalizer != "scene":  # D is one number as long as the camera stands still
                    continue
                default = (normalizer, cut) == ("scene", "soft")
                axes.plot(
                    [1 / r["steps"] for r in own], [max(r["pixel"], 0.2) for r in own], marker="o", markersize=3.5,
                    color=colours[normalizer], linestyle="-" if cut == "soft" else "--", linewidth=1.4 + default,
                    label=f"{normalizer}, {cut}{' (default)' if default else ''}", zorder=3 if default else 2,
                )  # fmt: skip
            limits = [r for r in rows if r["sweep"] == sweep and r.get("bound", 0) > 0]
            if limits:
                axes.plot([1 / r["steps"] for r in limits], [r["bound"] for r in limits], color=INK, linewidth=1.2,
                          linestyle=":", label="bound of the default")  # fmt: skip
            axes.axhline(TOGETHER, color=QUIET, linewidth=0.8)
            axes.set_title(title, loc="left", fontsize=9.5)
            axes.set(xscale="log", yscale="log", ylim=(0.15, 500))
            axes.set_xticks([1 / steps for steps in LENGTHS_OF_STEPS], [f"1/{steps}" for steps in LENGTHS_OF_STEPS])
            axes.set_xticks([], minor=True)
            label_log(axes.yaxis, "{:g}", subs=(1,))
            tidy(axes)
        panels[0].set_ylabel("largest change of a pixel in a step (of 255)")
        panels[0].text(1 / max(LENGTHS_OF_STEPS), TOGETHER * 0.9, f"one level for each of the {TOGETHER}", **NOTE)
        panels[1].text(1 / max(LENGTHS_OF_STEPS), 0.3, "scene, both thresholds: no change", **NOTE)
        panels[1].set_xlabel("length of a step, share of the sweep")
        handles = {h.get_label(): h for axes in panels for h in axes.get_lines() if not h.get_label().startswith("_")}
        figure.legend(handles.values(), handles.keys(), **LEGEND, ncols=4)
        save_figure(figure, path)
