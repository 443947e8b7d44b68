"""The demo's pictures are drawn and are not empty."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clod_adapter.demo import pictures
from clod_adapter.demo.pictures import Panel, dial_strip, quality_curve


def load(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def test_strip_shows_every_panel(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    colours = [(200, 30, 30), (30, 160, 30), (30, 30, 200)]
    images = [np.full((30, 40, 3), colour, np.uint8) for colour in colours]
    panels = [Panel(images[0], "photograph"), Panel(images[1] / 255, "s = 1", 40000, 1.0, 29.0, 20.0)]
    panels.append(Panel(images[2], "s = 3", 8000, 0.2))
    dial_strip(tmp_path / "strip.png", panels, "one view")
    plain = load(tmp_path / "strip.png")
    for k, colour in enumerate(colours):
        third = plain[:, k * plain.shape[1] // 3 : (k + 1) * plain.shape[1] // 3]
        assert (np.abs(third.astype(int) - colour).max(2) <= 1).mean() > 0.4
    assert (plain[0] == 255).all()
    dial_strip(tmp_path / "zoomed.png", panels, "one view", crop=(10, 5, 16, 12))
    added = load(tmp_path / "zoomed.png").shape[0] - plain.shape[0]
    assert added == pytest.approx(12 / 16 * plain.shape[1] / 3, rel=0.1)


def test_labels_of_the_curve_do_not_overlap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For the demo's own rows, with and without the base."""
    pytest.importorskip("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.transforms import Bbox

    kept = {1: 62814, 1.5: 43944, 2: 31812, 3: 18881, 5: 9737}
    psnr, ssim = (30.93, 30.73, 30.39, 29.60, 27.96), (937, 934, 928, 916, 887)
    values = zip(kept, kept.values(), psnr, (q / 1000 for q in ssim), strict=True)
    rows = [dict(zip(("virtual_scale", "kept", "psnr", "ssim"), row, strict=True)) for row in values]
    base = {"kept": 80000, "psnr": 31.42, "ssim": 0.9446}
    for given in (None, base):
        quality_curve(tmp_path / "curve.png", rows, given, "quality")
        picture = load(tmp_path / "curve.png")
        assert min(picture.shape[:2]) > 500 and 0.01 < (picture < 128).any(2).mean() < 0.5
    figures = []
    monkeypatch.setattr(pictures, "save_figure", lambda figure, path: figures.append(figure))
    quality_curve(tmp_path / "curve.png", rows, base, "quality")
    renderer = FigureCanvasAgg(figures[0]).get_renderer()
    figures[0].draw(renderer)
    for axes in figures[0].axes:
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
