"""The demo: photographs of a ray-traced gallery, a checkpoint trained on them, and figures of the
results.
"""

import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import torch

from clod_adapter.cameras import Scene, View, spread
from clod_adapter.evaluation.budget import matching_dial
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, importance
from clod_adapter.initialization.merging import merge
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.scene.load import load_scene
from clod_adapter.render import render
from clod_adapter.report import charts
from clod_adapter.report.page import Picture

SHARE = 0.2  # of the Gaussians, beside all
TITLE = "A held-out view: the checkpoint, and two ways to draw a fifth of its Gaussians"
FRAMES = 9  # of a panel, whose median time is given
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
    capture: Path,
    base: Path,
    model: Path,
    report: Mapping[str, Any],
    pictures: Mapping[str, Path],
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
    series = [
        charts.Series("the dial", report["rows"], dial=True),
        charts.Series(charts.BASE, report["base_rows"]),
        charts.Series("merged to as many", merged),
    ]
    with charts.chart(partial(charts.draw_rows, series=series, quantity="count")) as figure:
        charts.save_figure(figure, pictures["curve"])


def merging(base: Gaussians, scene: Scene) -> Callable[[int], Gaussians]:
    """Merges the base to a count, by importance for the photographs, without training."""
    cameras = [view.camera for view in spread(scene.train, MOST_VIEWS)]
    weights = importance(base, cameras)
    return partial(merge, base, importance=weights)


@torch.no_grad()
def compared(
    base: Gaussians,
    model: Gaussians,
    view: View,
    merged_to: Callable[[int], Gaussians],
) -> list[Picture]:
    """Panels of one view: the base, the dial at SHARE of the Gaussians, and the base merged to as
    many.
    """
    s = matching_dial(model, [view.camera], SHARE * len(base))
    (row,) = evaluate(model, [view], s)
    shown = [
        ("the checkpoint", base, 1.0),
        (f"the dial at s = {s:.2g}", model, s),
        ("the checkpoint, merged to as many", merged_to(round(row.kept)), 1.0),
    ]
    panels = []
    for title, gaussians, s in shown:
        (row,) = evaluate(gaussians, [view] * FRAMES, s)
        detail = f"{row.kept:,.0f} Gaussians, {row.psnr:.1f} dB\n{row.frame_ms:.1f} ms a frame"
        pixels = render(gaussians, view.camera, s).pixels
        panels.append(Picture(pixels.numpy(), title, detail))
    return panels


def dial_strip(
    path: str | Path,
    panels: Sequence[Picture],
    title: str,
    crop: tuple[int, int, int, int] = CROP,
) -> None:
    """Draws panels of one size side by side, above the part ``crop`` (left, top, width, height) of
    each enlarged.
    """
    height, width = panels[0].image.shape[:2]
    left, top = crop[:2]
    part_width, part_height = crop[2:]
    right = left + part_width
    bottom = top + part_height
    tall = [height / width, part_height / part_width]
    cell = 2.6  # inches
    inches = len(panels) * cell, cell * sum(tall) + 1.1
    with charts.new_figure(inches, layout="constrained") as figure:
        from matplotlib.patches import Rectangle

        figure.suptitle(title, fontsize=11, weight="bold", x=0.01, ha="left")
        columns = figure.subplots(2, len(panels), height_ratios=tall, squeeze=False).T
        for panel, (whole, part) in zip(panels, columns, strict=True):
            whole.imshow(panel.image, aspect="auto")
            enlarged = panel.image[top:bottom, left:right]
            part.imshow(enlarged, interpolation="nearest", aspect="auto")
            corner = left - 0.5, top - 0.5
            whole.add_patch(Rectangle(corner, part_width, part_height, fill=False, color="white"))
            whole.set_axis_off()
            part.set(xticks=[], yticks=[], frame_on=False)
            part.set_xlabel(f"{panel.title}\n{panel.detail}", fontsize=8.5, linespacing=1.35)
        charts.save_figure(figure, path)
