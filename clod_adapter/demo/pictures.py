"""The demo's figures: one view at several dial values, and quality against the number of Gaussians."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clod_adapter.cameras import View
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import load
from clod_adapter.io.scene.load import load_scene
from clod_adapter.render import render
from clod_adapter.report.page import Picture
from clod_adapter.report.style import BLUE, INK, ORANGE, QUIET, label_log, new_figure, save_figure, tidy

DIALS = (1.0, 2.0, 3.0, 5.0)
VIEW = 0  # the held-out view on the strip: across the whole room
CROP = (150, 150, 150, 75)  # left, top, width and height of the part shown enlarged, pixels


def draw(capture: Path, base: Path, model: Path, report: Mapping[str, Any], pictures: Mapping[str, Path]) -> None:
    """Draws a held-out view of the base and at several dial values, and the quality curve of all held-out views."""
    view, gaussians = load_scene(capture).test[VIEW], load(model).gaussians
    panels = [Picture(view.image.numpy(), "photograph", "held out from training")]
    panels += measured(load(base).gaussians, gaussians, DIALS, view)
    dial_strip(pictures["dial"], panels, "One file, one dial: a held-out view")
    with new_figure((6.4, 5.6), layout="constrained") as figure:
        quality_curve(figure, report["rows"], report["base_rows"][0])
        save_figure(figure, pictures["curve"])


@torch.no_grad()
def measured(base: Gaussians, model: Gaussians, dials: Sequence[float], view: View) -> list[Picture]:
    """Panels of the base and of the ascending dial values."""
    times = time_frames([(base, [1.0]), (model, dials)], [view.camera]).milliseconds
    shown = [("base", base, 1.0), *((f"s = {s:.3g}", model, s) for s in dials)]
    panels = []
    for (title, gaussians, s), taken in zip(shown, (*times[0], *times[1]), strict=True):
        (row,) = evaluate(gaussians, [view], [s])
        detail = f"{row.kept:,.0f} Gaussians ({row.kept_share:.0%})\n{row.psnr:.1f} dB,  {taken:.1f} ms a frame"
        panels.append(Picture(render(gaussians, view.camera, s).image.numpy(), title, detail))
    return panels


def dial_strip(path: str | Path, panels: Sequence[Picture], title: str, crop: tuple[int, int, int, int] = CROP) -> None:
    """Draws panels of one size side by side, above the part ``crop`` (left, top, width, height) of each enlarged."""
    height, width = panels[0].image.shape[:2]
    left, right, top, bottom = crop[0], crop[0] + crop[2], crop[1], crop[1] + crop[3]
    cell, gap, head, caption = 2.6, 0.08, 0.42, 0.66  # inches
    tall = [cell * height / width, cell * crop[3] / crop[2]]
    across, down = len(panels) * (cell + gap) + gap, sum(tall) + 2 * gap + head + caption
    with new_figure((across, down)) as figure:
        figure.text(gap / across, 1 - 0.5 * head / down, title, fontsize=11, weight="bold", va="center")
        for k, panel in enumerate(panels):
            pixels = panel.image if panel.image.dtype == np.uint8 else np.clip(panel.image, 0, 1)
            x, y = gap + k * (cell + gap), down - head
            whole = figure.add_axes((x / across, (y - tall[0]) / down, cell / across, tall[0] / down))
            y -= sum(tall) + gap
            part = figure.add_axes((x / across, y / down, cell / across, tall[1] / down))
            whole.imshow(pixels, interpolation="antialiased", aspect="auto")
            part.imshow(pixels[top:bottom, left:right], interpolation="nearest", aspect="auto")
            xs, ys = np.array([left, right, right, left, left]), np.array([top, top, bottom, bottom, top])
            whole.plot(xs - 0.5, ys - 0.5, color="white", linewidth=1.4, scalex=False, scaley=False)
            for axes in (whole, part):
                axes.axis("off")
            text = {"x": (x + cell / 2) / across, "ha": "center", "va": "top"}
            figure.text(y=(y - gap - 0.04) / down, s=panel.title, fontsize=10.5, weight="bold", **text)
            figure.text(y=(y - gap - 0.24) / down, s=panel.detail, fontsize=8.5, color=QUIET, linespacing=1.35, **text)
        save_figure(figure, path)


def quality_curve(figure: Any, rows: Sequence[Mapping[str, float]], base_row: Mapping[str, float]) -> None:
    """Draws PSNR, and below it SSIM, against the number of Gaussians kept, one labelled point per dial value."""
    title = "Quality against Gaussians, mean over the held-out views"
    figure.suptitle(title, fontsize=11, weight="bold", x=0.02, ha="left")
    both = figure.subplots(2, 1, sharex=True, height_ratios=[1.5, 1])
    ordered = sorted(rows, key=lambda row: row["virtual_scale"])
    for axes, key, label, colour in zip(both, ("psnr", "ssim"), ("PSNR (dB)", "SSIM"), (BLUE, ORANGE), strict=True):
        axes.set_xscale("log")
        axes.margins(x=0.1, y=0.16)
        points = [(row["kept"], row[key]) for row in ordered]
        axes.plot(*zip(*points, strict=True), "-o", color=colour, markersize=5.5, linewidth=1.8, zorder=3)
        for row, point in zip(ordered, points, strict=True):
            name = f"{row['virtual_scale']:g}"  # neighbours near s = 1 leave no room for more
            name = f"s = {name}" if row in (ordered[0], ordered[-1]) else name
            axes.annotate(name, point, (-4, 5), textcoords="offset points", ha="right", fontsize=8.5)
        spot = (base_row["kept"], base_row[key])
        axes.plot(*spot, "D", color="white", markeredgecolor=INK, markersize=7, zorder=2)
        axes.annotate("base", spot, (0, 8), textcoords="offset points", ha="center", fontsize=8.5)
        axes.set_ylabel(label)
        tidy(axes)
    axes.set_xlabel("Gaussians kept (log scale)")
    label_log(axes.xaxis)
