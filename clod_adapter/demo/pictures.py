"""The demo's figures: one view at several dial values, and quality against the number of Gaussians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from clod_adapter.report.style import BLUE, INK, ORANGE, QUIET, label_log, new_figure, save_figure, tidy

DIALS = (1.0, 2.0, 3.0, 5.0)
VIEW = 0  # the held-out view on the strip: across the whole room
CROP = (150, 150, 150, 75)  # left, top, width and height of the part shown enlarged, pixels


@dataclass(frozen=True)
class Panel:
    """One image of the strip.

    Attributes:
        image: ``[H, W, 3]`` uint8, or float in 0..1; the same size in every panel.
        heading: what it shows.
        kept: Gaussians that are not culled; 0 for a photograph.
        kept_share: their share of all, in [0, 1].
        psnr: dB against the ground truth.
        frame_ms: time of a frame, milliseconds.
    """

    image: np.ndarray
    heading: str
    kept: float = 0.0
    kept_share: float = 0.0
    psnr: float = 0.0
    frame_ms: float = 0.0


def draw(capture: Path, base: Path, model: Path, report: Mapping[str, Any], pictures: Mapping[str, Path]) -> None:
    """Draws a held-out view of the base and at several dial values, and the quality curve of all held-out views.

    Args:
        report: of the adaptation; pictures: the files to write, ``dial`` and ``curve``.
    """
    view, gaussians = load_scene(capture).test[VIEW], load(model).gaussians
    panels = [Panel(view.image.numpy(), "photograph"), *measured(load(base).gaussians, gaussians, DIALS, view)]
    dial_strip(pictures["dial"], panels, "One file, one dial: a held-out view", crop=CROP)
    title = "Quality against Gaussians, mean over the held-out views"
    quality_curve(pictures["curve"], report["rows"], report["base_rows"][0], title)


@torch.no_grad()
def measured(base: Gaussians, model: Gaussians, dials: Sequence[float], view: View) -> list[Panel]:
    """Panels of the base and of the ascending dial values."""
    times = time_frames([(base, [1.0]), (model, dials)], [view.camera]).milliseconds
    shown = [("base", base, 1.0), *((f"s = {s:.3g}", model, s) for s in dials)]
    panels = []
    for (heading, gaussians, s), taken in zip(shown, (*times[0], *times[1]), strict=True):
        (row,) = evaluate(gaussians, [view], [s])
        image = render(gaussians, view.camera, s).image.numpy()
        panels.append(Panel(image, heading, row.kept, row.kept_share, row.psnr, taken))
    return panels


def dial_strip(
    path: str | Path, panels: Sequence[Panel], title: str, crop: tuple[int, int, int, int] | None = None
) -> None:
    """Draws one view side by side: photograph, base, dial values.

    Args:
        path: the picture to write; its suffix chooses the format.
        panels: from left to right.
        title: one line above.
        crop: left, top, width, height in pixels of a part to show enlarged in a second row.

    Raises:
        ClodError: matplotlib is missing, or the file cannot be written.
    """
    height, width = panels[0].image.shape[:2]
    rows = [height / width] + ([crop[3] / crop[2]] if crop else [])
    cell, gap, head, caption = 2.6, 0.08, 0.42, 0.66  # inches
    across, down = len(panels) * (cell + gap) + gap, sum(rows) * (cell + gap) + head + caption
    with new_figure((across, down)) as figure:
        figure.text(gap / across, 1 - 0.5 * head / down, title, fontsize=11, weight="bold", va="center")
        for k, panel in enumerate(panels):
            left, top = gap + k * (cell + gap), down - head
            for row, aspect in enumerate(rows):
                tall = cell * aspect
                axes = figure.add_axes((left / across, (top - tall) / down, cell / across, tall / down))
                shown_panel(axes, panel.image, crop, enlarged=row == 1)
                top -= tall + gap
            write_caption(figure, panel, (left + cell / 2) / across, top, down)
        save_figure(figure, path)


def shown_panel(axes: Any, image: np.ndarray, crop: tuple[int, int, int, int] | None, enlarged: bool) -> None:
    """Shows an image, or with `enlarged` its crop, in the axes; the whole image gets an outline of the crop."""
    axes.axis("off")
    pixels = image if image.dtype == np.uint8 else np.clip(image, 0, 1)
    if enlarged and crop:
        left, top, width, height = crop
        axes.imshow(pixels[top : top + height, left : left + width], interpolation="nearest", aspect="auto")
        return
    axes.imshow(pixels, interpolation="antialiased", aspect="auto")
    if crop:
        x, y = (crop[0] - 0.5, crop[0] + crop[2] - 0.5), (crop[1] - 0.5, crop[1] + crop[3] - 0.5)
        outline = [x[0], x[1], x[1], x[0], x[0]], [y[0], y[0], y[1], y[1], y[0]]
        axes.plot(*outline, color="white", linewidth=1.4, scalex=False, scaley=False)


def write_caption(figure: Any, panel: Panel, x: float, y: float, down: float) -> None:
    """Heading, count, PSNR and frame time, centred on x (share of the width) below y (inches of `down`)."""
    detail = "held out from training"
    if panel.kept:
        quality = f"{panel.psnr:.1f} dB,  {panel.frame_ms:.1f} ms a frame"
        detail = f"{panel.kept:,.0f} Gaussians ({panel.kept_share:.0%})\n{quality}"
    figure.text(x, (y - 0.04) / down, panel.heading, fontsize=10.5, weight="bold", ha="center", va="top")
    figure.text(x, (y - 0.24) / down, detail, fontsize=8.5, color=QUIET, ha="center", va="top", linespacing=1.35)


def quality_curve(
    path: str | Path, rows: Sequence[Mapping[str, float]], base_row: Mapping[str, float] | None, title: str
) -> None:
    """Draws PSNR, and below it SSIM, against the number of Gaussians kept, one labelled point per dial value.

    Args:
        path: the picture to write; its suffix chooses the format.
        rows: with virtual_scale, psnr, ssim, kept and kept_share, in any order.
        base_row: the checkpoint before adapting, with psnr, ssim and kept; drawn as a separate point.
        title: one line above.

    Raises:
        ClodError: matplotlib is missing, or the file cannot be written.
    """
    ordered = sorted(rows, key=lambda row: row["virtual_scale"])
    with new_figure((6.4, 5.6), layout="constrained") as figure:
        figure.suptitle(title, fontsize=11, weight="bold", x=0.02, ha="left")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1.5, 1])
        draw_curve(above, ordered, base_row, "psnr", BLUE)
        draw_curve(below, ordered, base_row, "ssim", ORANGE)
        above.set_ylabel("PSNR (dB)")
        below.set_ylabel("SSIM")
        below.set_xlabel("Gaussians kept (log scale)")
        label_log(below.xaxis)
        save_figure(figure, path)


def draw_curve(
    axes: Any, rows: Sequence[Mapping[str, float]], base_row: Mapping[str, float] | None, key: str, colour: str
) -> None:
    """One metric against the count; points are labelled with their dial values."""
    counts, values = [row["kept"] for row in rows], [row[key] for row in rows]
    axes.set_xscale("log")
    axes.margins(x=0.1, y=0.16)
    axes.plot(counts, values, "-o", color=colour, markersize=5.5, linewidth=1.8, zorder=3)
    for row, count, value in zip(rows, counts, values, strict=True):
        name = f"{row['virtual_scale']:g}"  # neighbours near s = 1 leave no room for more
        name = f"s = {name}" if row in (rows[0], rows[-1]) else name
        axes.annotate(name, (count, value), (-4, 5), textcoords="offset points", ha="right", fontsize=8.5)
    if base_row:
        style = {"color": "white", "markeredgecolor": INK, "markersize": 7, "zorder": 2}
        axes.plot(base_row["kept"], base_row[key], "D", **style)
        spot = (base_row["kept"], base_row[key])
        axes.annotate("base", spot, (0, 8), textcoords="offset points", ha="center", fontsize=8.5)
    tidy(axes)
