"""The demo's pictures are drawn and are not empty."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clod_adapter.demo.pictures import dial_strip, quality_curve
from clod_adapter.report.page import Picture
from clod_adapter.report.style import new_figure

pytest.importorskip("matplotlib")


def test_strip_shows_every_panel(tmp_path: Path) -> None:
    colours = [(200, 30, 30), (30, 160, 30), (30, 30, 200)]
    images = [np.full((30, 40, 3), colour, np.uint8) for colour in colours]
    panels = [Picture(image / 255 if k == 1 else image, "s = 1", "29.0 dB") for k, image in enumerate(images)]
    dial_strip(tmp_path / "strip.png", panels, "one view", crop=(10, 5, 16, 12))
    picture = np.asarray(Image.open(tmp_path / "strip.png").convert("RGB"))
    for k, colour in enumerate(colours):
        third = picture[:, k * picture.shape[1] // 3 : (k + 1) * picture.shape[1] // 3]
        assert (np.abs(third.astype(int) - colour).max(2) <= 1).mean() > 0.6
    assert (picture[0] == 255).all() and picture.shape[0] > 2 * 12 / 16 * picture.shape[1] / 3


def test_labels_of_the_curve_do_not_overlap() -> None:
    """For the demo's own rows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.transforms import Bbox

    kept = {1: 62814, 1.5: 43944, 2: 31812, 3: 18881, 5: 9737}
    psnr, ssim = (30.93, 30.73, 30.39, 29.60, 27.96), (937, 934, 928, 916, 887)
    values = zip(kept, kept.values(), psnr, (q / 1000 for q in ssim), strict=True)
    rows = [dict(zip(("virtual_scale", "kept", "psnr", "ssim"), row, strict=True)) for row in values]
    with new_figure((6.4, 5.6), layout="constrained") as figure:
        quality_curve(figure, rows, {"kept": 80000, "psnr": 31.42, "ssim": 0.9446})
        renderer = FigureCanvasAgg(figure).get_renderer()
        figure.draw(renderer)
    for axes in figure.axes:
        labels = [text.get_window_extent(renderer) for text in axes.texts]
        marks = [
            Bbox.from_bounds(x - 8, y - 8, 16, 16)
            for line in axes.lines
            for x, y in axes.transData.transform(line.get_xydata())
        ]
        assert len(labels) == len(marks) == len(rows) + 1
        for k, label in enumerate(labels):
            assert not label.count_overlaps([*labels[:k], *labels[k + 1 :], *marks]), axes.texts[k].get_text()
        assert axes.get_legend() is None
