"""``--report``: the page of adapting and of ``eval``."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from clod_adapter.cli.shared import pages

pytest.importorskip("matplotlib")
ADAPT = "BASE --images SCENE --iters 16 --max-sv 4 --out dial.ply --report"


def page_of(path: Path) -> tuple[str, dict[str, Any]]:
    """Its text, and the data in it."""
    text = path.read_text(encoding="utf-8")
    found = re.search(r'id="data">(.*?)</script>', text, re.S)
    assert found
    return text, json.loads(found[1])


def test_adapt(clod: Any, tmp_path: Path) -> None:
    report = clod(ADAPT, "--json").report
    files = {"page": "dial.html", "rendering": "dial_rendering.png", "adapting": "dial_adapting.png"}
    assert report["outputs"].items() >= files.items() and all((tmp_path / f).is_file() for f in files.values())
    text, page = page_of(tmp_path / "dial.html")
    assert all(page["report"][name] == report[name] for name in ("rows", "base_rows", "plan"))
    curves = page["training"]["curves"]
    assert [curve["label"] for curve in curves] == ["s = 1", "s = 3", "s = 4"]
    for curve, dial in zip(curves, (1, 3, 4), strict=True):
        seconds = [point["seconds"] for point in curve["points"]]
        assert seconds == sorted(seconds) and len(seconds) == 5  # steps 1, 2, 4, 8 and 16, the end
        assert len({point["psnr"] for point in curve["points"]}) == 5  # each of its own time
        (row,) = [row for row in report["rows"] if row["virtual_scale"] == dial]
        assert curve["points"][-1]["psnr"] == row["psnr"]
    trained = report["seconds"]["start"] + report["seconds"]["train"]
    assert curves[0]["points"][-1]["seconds"] == pytest.approx(trained, abs=0.05)
    assert "change no pixel of" in text and "base.ply, a trained splat of 300 Gaussians" in text
    assert text.count("<svg") == 4
    assert text.count('data-name=""') == pages.FRAMES and text.count('data-name="base"') == 1


def test_eval(clod: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without matplotlib the page is refused before any work."""
    report = clod("eval DIAL --images SCENE --report look.html --json --base BASE").report
    assert report["outputs"] == {"page": "look.html", "rendering": "look_rendering.png"}
    text, page = page_of(tmp_path / "look.html")
    assert page["report"]["rows"] == report["rows"] and page["training"] is None
    assert 'data-name="base"' in text and "hold for base" in text
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "pip install matplotlib" in clod(ADAPT, code=2).err
