"""The demo: photographs of a ray-traced gallery, a checkpoint trained on them, and figures of the
results.
"""

import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clod_adapter.cameras import Scene, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.evaluation.budget import matching_dial
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, importance
from clod_adapter.initialization.merging import merge
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.scene.load import load_scene
from clod_adapter.render import render
from clod_adapter.report.charts import BLUE, INK, ORANGE, label_log, new_figure, save_figure
from clod_adapter.report.page import Picture

SHARE = 0.2  # of the Gaussians, beside all
TITLE = "A held-out view: the checkpoint, and two ways to draw a fifth of its Gaussians"
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
    """Draws a held-out view of the base, the dial and the merged base, and their quality over all
    held-out views.
    """
    scene = load_scene(capture)
    original = load(base).gaussians
    merged_to = merging(original, scene)
    strip = compared(original, load(model).gaussians, scene.test[VIEW], merged_to)
    dial_strip(pictures["dial"], strip, TITLE)
    merged = []
    for row in report["rows"]:
        (measured,) = evaluate(merged_to(round(row["kept"])), scene.test, 1.0)
        merged.append(measured.as_dict())
    with new_figure((6.4, 5.6), layout="constrained") as figure:
        quality_curve(figure, report["rows"], merged, report["base_rows"][0])
        save_figure(figure, pictures["curve"])


def merging(base: Gaussians, scene: Scene) -> Callable[[int], Gaussians]:
    """Merges the base to a count, by importance for the photographs, without training."""
    return partial(merge, base, importance(base, spread(scene.train, MOST_VIEWS), AdaptConfig()))


def compared(
    base: Gaussians, model: Gaussians, view: View, merged_to: Callable[[int], Gaussians]
) -> list[Picture]:
    """Panels of one view: the base, the dial at SHARE of the Gaussians, and the base merged to as
    many. Frame times are left out where the machine is busy.
    """
    s = matching_dial(model, [view.camera], SHARE * len(base))
    (row,) = evaluate(model, [view], s)
    shown = [
        ("the checkpoint", base, 1.0),
        (f"the dial at s = {s:.2g}", model, s),
        ("the checkpoint, merged to as many", merged_to(round(row.kept)), 1.0),
    ]
    times = time_frames([(gaussians, [s]) for _, gaussians, s in shown], [view.camera])
    panels = []
    for (title, gaussians, s), (taken,), (between,) in zip(
        shown, times.milliseconds, times.ranges, strict=True
    ):
        (row,) = evaluate(gaussians, [view], s)
        detail = f"{row.kept:,.0f} Gaussians, {row.psnr:.1f} dB"
        if not times.notes:
            detail += f"\n{taken:.1f} ± {between / 2:.1f} ms a frame"
        with torch.no_grad():
            image = render(gaussians, view.camera, s).image
        panels.append(Picture(image.numpy(), title, detail))
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
    tall = [height / width, crop[3] / crop[2]]
    cell = 2.6  # inches
    with new_figure((len(panels) * cell, cell * sum(tall) + 1.1), layout="constrained") as figure:
        figure.suptitle(title, fontsize=11, weight="bold", x=0.01, ha="left")
        columns = figure.subplots(2, len(panels), height_ratios=tall, squeeze=False).T
        for panel, (whole, part) in zip(panels, columns, strict=True):
            pixels = panel.image if panel.image.dtype == np.uint8 else np.clip(panel.image, 0, 1)
            whole.imshow(pixels, interpolation="antialiased", aspect="auto")
            part.imshow(pixels[top:bottom, left:right], interpolation="nearest", aspect="auto")
            xs = np.array([left, right, right, left, left])
            ys = np.array([top, top, bottom, bottom, top])
            whole.plot(xs - 0.5, ys - 0.5, color="white", linewidth=1.4, scalex=False, scaley=False)
            whole.set_axis_off()
            part.set(xticks=[], yticks=[], frame_on=False)
            part.set_xlabel(f"{panel.title}\n{panel.detail}", fontsize=8.5, linespacing=1.35)
        save_figure(figure, path)


def quality_curve(
    figure: Any,
    rows: Sequence[Mapping[str, float]],
    merged: Sequence[Mapping[str, float]],
    base_row: Mapping[str, float],
) -> None:
    """Draws PSNR, and below it SSIM, against the number of Gaussians kept: the dial, one labelled
    point per dial value, and the merged base.
    """
    title = "Quality against Gaussians, mean over the held-out views"
    figure.suptitle(title, fontsize=11, weight="bold", x=0.02, ha="left")
    both = figure.subplots(2, 1, sharex=True, height_ratios=[1.5, 1])
    for axes, key, label in zip(both, ("psnr", "ssim"), ("PSNR (dB)", "SSIM"), strict=True):
        axes.set_xscale("log")
        axes.margins(x=0.1, y=0.16)
        for name, some, colour in (("the dial", rows, BLUE), ("merged", merged, ORANGE)):
            kept = [row["kept"] for row in some]
            values = [row[key] for row in some]
            axes.plot(kept, values, "-o", color=colour, linewidth=1.8, label=name)
        points = [("base", base_row), *((f"{row['virtual_scale']:g}", row) for row in rows)]
        for text, row in points:
            place = row["kept"], row[key]
            axes.annotate(
                text, place, (-4, 5), textcoords="offset points", ha="right", fontsize=8.5
            )
        place = base_row["kept"], base_row[key]
        axes.plot(*place, "D", color="white", markeredgecolor=INK, markersize=7, zorder=1)
        axes.set_ylabel(label)
    both[0].legend(loc="lower right", frameon=False)
    axes.set_xlabel("Gaussians kept (log scale); the numbers are dial values")
    label_log(axes.xaxis)
