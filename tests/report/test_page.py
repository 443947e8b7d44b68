"""The page is self-contained and escapes its texts; its charts have log axes, and labels that do
not collide.
"""

import base64
import io
import json
import re
import sys
from itertools import product

import numpy as np
import pytest
from PIL import Image
from refusals import refused

from clod_adapter.report.charts import Series, draw_rows, new_figure, series_of
from clod_adapter.report.page import Picture, write_page
from runs import data_in

pytest.importorskip("matplotlib")
NASTY = r'a <b> & "c" $\co$ </script>'


def row(s, psnr=20.0, ms=3.0):
    return {
        "virtual_scale": s,
        "psnr": psnr,
        "ssim": 0.9,
        "kept": 10 / s,
        "kept_share": 0.5,
        "in_view": 9,
        "frame_ms": ms,
    }


def report(**changes):
    made = {"what": NASTY, "verdict": "kept", "measured": "-", "why": NASTY}
    return {
        "command": "adapt",
        "version": "1",
        "model": NASTY,
        "scene": NASTY,
        "base_count": 10,
        "steps": 9,
        "interrupted": False,
        "seconds": {"train": 60.0, "total": 215.4},
        "machine": {"cpu": NASTY},
        "device": "cpu",
        "notes": [NASTY],
        "config": {"seed": 1},
        "plan": {"decisions": [made]},
        "rows": [row(s, 30 - s, 20 / s) for s in (1, 2, 5)],
        "base_rows": [row(1, 29.5, 25)],
        "detached_row": row(1, 19),
    } | changes


def test_page_is_self_contained_and_escaped(tmp_path, monkeypatch):
    path = tmp_path / "page.html"
    levels = [np.full((6, 8, 3), level, np.uint8) for level in (0, 128, 255)]
    frames = [Picture(level, NASTY, NASTY) for level in levels]
    curve = {"label": NASTY, "points": [{"seconds": 2, "psnr": 20}] * 2}
    training = {"views": 2, "base_psnr": 29.0, "curves": [curve]}
    written = write_page(path, report(), frames, {"photograph": frames[0]}, training)
    assert set(tmp_path.iterdir()) == set(written.values())
    text = path.read_text("utf-8")
    visible = text.partition('<script type="application/json"')[0]
    assert "a <b>" not in visible and "a &lt;b&gt; &amp;" in visible and "9 steps on" in visible
    for part in ("3:35 minutes in all", "29.00 dB", "base, unadapted", ".tiles > div {"):
        assert part in visible
    foreign = r"<link|<iframe|<script[^>]* src|https?://(?!www\.w3\.org)|@import|url\((?!#)"
    assert not re.search(foreign, text)
    urls = re.findall(r'\b(?:src|href)="([^"]*)"', text)
    assert all(url.startswith(("data:", "#")) for url in urls)
    names = re.findall(r'\bid="([^"]+)"', text)
    assert len(names) == len(set(names)) > 10
    colours = re.findall(r"var\([^)]*\)", text.split("<svg")[1])
    assert {"var(--ink)", "var(--quiet)", "var(--series-1)"} <= set(colours)
    (stored,) = data_in(text, "data")
    assert json.loads(stored) == {"report": report(), "training": training} and "<" not in stored
    shown = re.findall(r'<img [^>]*data-name="([^"]*)" data-title', text)
    assert shown == ["", "", "", "photograph"]
    for png in (written["rendering"], written["adapting"]):
        pixels = np.asarray(Image.open(png).convert("RGB"))
        assert min(pixels.shape[:2]) > 500 and 0.005 < (pixels < 128).any(2).mean() < 0.3
    own = report(rows=[], base_rows=[], detached_row=None, supervision="checkpoint")
    write_page(path, own, frames, {"base": frames[0]})
    text = path.read_text("utf-8")
    for part in ("Nothing was measured", "steps on synthetic views", "hold for base"):
        assert part in text
    told = text.partition("Settings and machine")[0]
    assert re.findall(r"\S+ photograph", told) == ["without photograph"]
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with refused("pip install matplotlib"):
        write_page(tmp_path / "other.html", report(), [], {})
    assert not (tmp_path / "other.html").exists()


def test_images_are_embedded():
    """Small ones keep their pixels; wide ones are scaled down."""
    ramp = np.linspace(0, 255, 32 * 24 * 3).reshape(24, 32, 3)
    images = (ramp.astype(np.uint8), np.zeros((300, 2000, 3), np.uint8))
    urls = [Picture(each, "").url.removeprefix("data:image/webp;base64,") for each in images]
    small, wide = (Image.open(io.BytesIO(base64.b64decode(url))) for url in urls)
    assert wide.size == (1000, 150)
    assert np.abs(np.asarray(small.convert("RGB"), float) - ramp).mean() < 4


def test_charts():
    """Log axes with PSNR on the right; where dial values are near each other, not all have
    labels.
    """
    dials = (1.0, 1.01, 1.02, 2.0, 4.0)
    series = [
        Series("dial", [row(s, 30 - s, 20 / s) for s in dials], dial=True),
        Series("base", [row(1, 29.5, 25)]),
    ]
    with new_figure((6, 4)) as figure:
        draw_rows(figure.subplots(), series, "rendering")
        figure.draw_without_rendering()
        (left,) = figure.axes
        assert left.get_xscale() == left.get_yscale() == "log"
        dial, base = left.get_lines()
        assert dial.get_xdata().tolist() == [20 / s for s in dials]
        assert base.get_linestyle() == "None"
        assert dial.get_ydata() == pytest.approx([10 ** (s / 10) for s in dials])
        labels = [text for text in left.texts if text.get_text().startswith("s = ")]
        assert sorted(text.get_text() for text in labels) == ["s = 1", "s = 2", "s = 4"]
        (right,) = left.child_axes
        errors = [1e3 * 10 ** (-psnr / 10) for psnr in reversed(right.get_ylim())]
        assert left.get_ylim() == pytest.approx(errors)


def test_a_chart_by_count_leaves_out_nothing_drawn():
    """A log axis has no 0."""
    empty = row(40, 5) | {"kept": 0}
    series = [Series("dial", [row(1, 30), row(2, 25), empty], dial=True), Series("base", [empty])]
    with new_figure((6, 4)) as figure:
        draw_rows(figure.subplots(), series, "count")
        figure.draw_without_rendering()
        (dial,) = figure.axes[0].get_lines()
        assert dial.get_ydata() == pytest.approx([1, 10**0.5])


def test_series_of_reports():
    """The dial, the base and its pruned versions, other files, and the file without its dial; rows
    without a PSNR.
    """
    compared = {
        "rows": [row(1), row(3), row(5, None)],
        "base_row": row(1, 22),
        "detached_row": row(1, 19),
        "ranked": [
            {"by": by, "row": row(1, psnr)}
            for psnr, by in product((21, 17), ("opacity", "removal error"))
        ],
        "against": [
            {"model": "x/a.ply", "label": "x_a", "theirs": row(1)},
            *({"model": "y/a.ply", "label": "y_a", "theirs": row(s)} for s in (1, 3)),
        ],
    }
    psnr = {}
    for one in series_of(compared):
        psnr[one.label] = [row["psnr"] for row in one.rows]
    assert psnr == {
        "dial, one file": [20, 20],
        "base, unadapted": [22],
        "base pruned by opacity": [21, 17],
        "base pruned by removal error": [21, 17],
        "x_a": [20],
        "y_a": [20, 20],
        "plain viewer, no dial": [19],
    }
    dials = {one.label for one in series_of(compared) if one.dial}
    assert dials == {"dial, one file", "y_a"}
    (plain,) = series_of({"rows": [row(1), row(2)], "attenuation": None})
    assert (plain.label, plain.dial) == ("the file, no dial", False)
    assert series_of({"rows": [], "base_rows": [], "detached_row": None}) == []
