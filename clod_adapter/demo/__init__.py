"""The demo: photographs of a ray-traced gallery, a checkpoint trained on them, and figures of the
results.
"""

import zipfile
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clod_adapter.cameras import View
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.scene.load import load_scene
from clod_adapter.render import render
from clod_adapter.report.charts import BLUE, INK, ORANGE, label_log, new_figure, save_figure
from clod_adapter.report.page import Picture

DIALS = (1.0, 2.0, 3.0, 5.0)
VIEW = 0  # the held-out view on the strip: across the whole room
CROP = (150, 150, 150, 75)  # left, top, width and height of the part shown enlarged, pixels


def unpack(capture: Path, base: Path) -> None:
    """Writes the capture and the base checkpoint that come with the package, unless they exist."""
    packed = resources.files("clod_adapter.demo")
    if not capture.exists():
        with (
            atomic_path(capture) as part,
            (packed / "capture.zip").open("rb") as file,
            zipfile.ZipFile(file) as photos,
        ):
            photos.extractall(part)
    if not base.exists():
        with resources.as_file(packed / "base.spz") as path:
            save(base, load(path).gaussians)


def draw(
    capture: Path, base: Path, model: Path, report: Mapping[str, Any], pictures: Mapping[str, Path]
) -> None:
    """Draws a held-out view of the base and at several dial values, and the quality curve of all
    held-out views.
    """
    view, gaussians = load_scene(capture).test[VIEW], load(model).gaussians
    panels = [Picture(view.image.numpy(), "photograph", "held out from training")]
    panels += measured(load(base).gaussians, gaussians, DIALS, view)
    dial_strip(pictures["dial"], panels, "One file, one dial: a held-out view")
    with new_figure((6.4, 5.6), layout="constrained") as figure:
        quality_curve(figure, report["rows"], report["base_rows"][0])
        save_figure(figure, pictures["curve"])


@torch.no_grad()
def measured(
    base: Gaussians, model: Gaussians, dials: Sequence[float], view: View
) -> list[Picture]:
    """Panels of the base and of the ascending dial values."""
    times = time_frames([(base, [1.0]), (model, dials)], [view.camera]).milliseconds
    shown = [("base", base, 1.0), *((f"s = {s:.3g}", model, s) for s in dials)]
    panels = []
    for (title, gaussians, s), taken in zip(shown, (*times[0], *times[1]), strict=True):
        (row,) = evaluate(gaussians, [view], [s])
        detail = (
            f"{row.kept:,.0f} Gaussians ({row.kept_share:.0%})\n{row.psnr:.1f} dB,  {taken:.1f} ms"
            " a frame"
        )
        panels.append(Picture(render(gaussians, view.camera, s).image.numpy(), title, detail))
    return panels


def dial_strip(
    path: str | Path, panels: Sequence[Picture], title: str, crop: tuple[int, int, int, int] = CROP
) -> None:
    """Draws panels of one size side by side, above the part ``crop`` (left, top, width, height) of
    each enlarged.
    """
    height, width = panels[0].image.shape[:2]
    left = crop[0]
    right = crop[0] + crop[2]
    top = crop[1]
    bottom = crop[1] + crop[3]
    tall, cell = [height / width, crop[3] / crop[2]], 2.6  # inches
    with new_figure((len(panels) * cell, cell * sum(tall) + 1.1), layout="constrained") as figure:
        figure.suptitle(title, fontsize=11, weight="bold", x=0.01, ha="left")
        columns = figure.subplots(2, len(panels), height_ratios=tall, squeeze=False).T
        for panel, (whole, part) in zip(panels, columns, strict=True):
            pixels = panel.image if panel.image.dtype == np.uint8 else np.clip(panel.image, 0, 1)
            whole.imshow(pixels, interpolation="antialiased", aspect="auto")
            part.imshow(pixels[top:bottom, left:right], interpolation="nearest", aspect="auto")
            xs, ys = (
                np.array([left, right, right, left, left]),
                np.array([top, top, bottom, bottom, top]),
            )
            whole.plot(xs - 0.5, ys - 0.5, color="white", linewidth=1.4, scalex=False, scaley=False)
            whole.set_axis_off()
            part.set(xticks=[], yticks=[], frame_on=False)
            part.set_xlabel(f"{panel.title}\n{panel.detail}", fontsize=8.5, linespacing=1.35)
        save_figure(figure, path)


def quality_curve(
    figure: Any, rows: Sequence[Mapping[str, float]], base_row: Mapping[str, float]
) -> None:
    """Draws PSNR, and below it SSIM, against the number of Gaussians kept, one labelled point per
    dial value.
    """
    title = "Quality against Gaussians, mean over the held-out views"
    figure.suptitle(title, fontsize=11, weight="bold", x=0.02, ha="left")
    both = figure.subplots(2, 1, sharex=True, height_ratios=[1.5, 1])
    for axes, key, label, colour in zip(
        both, ("psnr", "ssim"), ("PSNR (dB)", "SSIM"), (BLUE, ORANGE), strict=True
    ):
        axes.set_xscale("log")
        axes.margins(x=0.1, y=0.16)
        points = [("base", (base_row["kept"], base_row[key]))]
        points += [(f"{row['virtual_scale']:g}", (row["kept"], row[key])) for row in rows]
        axes.plot(
            *zip(*(point for _, point in points[1:]), strict=True),
            "-o",
            color=colour,
            linewidth=1.8,
        )
        axes.plot(*points[0][1], "D", color="white", markeredgecolor=INK, markersize=7, zorder=1)
        for text, point in points:
            axes.annotate(
                text, point, (-4, 5), textcoords="offset points", ha="right", fontsize=8.5
            )
        axes.set_ylabel(label)
    axes.set_xlabel("Gaussians kept (log scale); the numbers are dial values")
    label_log(axes.xaxis)
