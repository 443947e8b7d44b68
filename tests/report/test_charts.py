"""The charts have log axes with PSNR beside the error, and use a page's colours."""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from clod_adapter.errors import ClodError
from clod_adapter.report.charts import error, inline_svg, rendering_chart, training_chart, write_chart
from clod_adapter.report.series import Series
from clod_adapter.report.style import new_figure, shades

DIAL = Series("dial", [{"virtual_scale": s, "psnr": 30 - s, "frame_ms": 20 / s} for s in (1.0, 2.0, 4.0)], dial=True)
BASE = Series(r"base & $\co$", [{"virtual_scale": 1.0, "psnr": 29.5, "frame_ms": 25.0}])
CURVES = [{"label": "s = 1", "points": [{"seconds": 2.0**k, "psnr": 20.0 + k} for k in range(6)]}]


def axes_of(draw: Any) -> list[Any]:
    with new_figure((6, 4)) as figure:
        draw(figure)
        return list(figure.axes)


def test_rendering_chart() -> None:
    pytest.importorskip("matplotlib")
    left, right = axes_of(rendering_chart([DIAL, BASE]))
    assert (left.get_xscale(), left.get_yscale(), right.get_yscale()) == ("log", "log", "log")
    dial, base = left.get_lines()
    assert dial.get_xdata().tolist() == [20, 10, 5] and base.get_linestyle() == "None"
    assert dial.get_ydata() == pytest.approx([10**-2.9, 10**-2.8, 10**-2.6])
    assert [text.get_text() for text in left.texts][:3] == ["s = 1", "s = 2", "s = 4"]
    assert left.get_ylim() == right.get_ylim() and left.get_yticks().tolist() == right.get_yticks().tolist()
    for tick, label in zip(right.get_yticks(), right.get_yticklabels(), strict=True):
        assert error(float(label.get_text())) == pytest.approx(tick)
    assert len(right.get_yticks()) >= 3


def test_training_chart() -> None:
    pytest.importorskip("matplotlib")
    left, _ = axes_of(training_chart(CURVES, 29.0))
    curve, base = left.get_lines()
    assert curve.get_xdata().tolist() == [1, 2, 4, 8, 16, 32] and base.get_ydata() == pytest.approx([10**-2.9] * 2)
    assert len(axes_of(training_chart(CURVES, None))[0].get_lines()) == 1


def test_chart_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    write_chart(tmp_path / "chart.png", rendering_chart([DIAL, BASE]))
    pixels = np.asarray(Image.open(tmp_path / "chart.png").convert("RGB"))
    assert min(pixels.shape[:2]) > 500 and 0.005 < (pixels < 128).any(2).mean() < 0.3
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ClodError, match=re.escape("pip install matplotlib")):
        write_chart(tmp_path / "other.png", training_chart(CURVES, None))
    assert not (tmp_path / "other.png").exists()


def test_svg_has_the_pages_colours_and_fonts() -> None:
    pytest.importorskip("matplotlib")
    svg = inline_svg(rendering_chart([DIAL, BASE]), "a chart")
    root = ElementTree.fromstring(svg)
    assert root.get("viewBox") and root.get("width") is None and root.get("aria-label") == "a chart"
    assert {"var(--ink)", "var(--quiet)", "var(--series-1)", "var(--series-2)"} <= set(re.findall(r"var\([^)]*\)", svg))
    assert not re.findall(r"#(?!000000|ffffff)[0-9a-f]{6}", svg) and "DejaVu" not in svg
    assert "base &amp; $\\co$" in svg
    for count in (1, 2, 5):  # from light to dark
        sums = [sum(bytes.fromhex(colour[1:])) for colour in shades(count)]
        assert len(sums) == count and sums == sorted(sums, reverse=True) and len(set(sums)) == count
