"""``--report``: the page, and interrupts of it."""

from __future__ import annotations

import json
import re
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from clod_adapter.cli.shared import pages
from clod_adapter.cli.shared.console import Console
from clod_adapter.config import AdaptConfig
from clod_adapter.training.loop import adapt
from runs import OUTPUTS, names, pressing
from scenes import capture as small_capture

pytest.importorskip("matplotlib")
TINY = ("--iters", 16, "--max-sv", 4, "--out", "dial.ply")


def stored(path: Path) -> dict[str, Any]:
    found = re.search(r'id="data">(.*?)</script>', path.read_text(encoding="utf-8"), re.S)
    assert found
    return json.loads(found[1])  # type: ignore[no-any-return]


def test_adapt(clod: Any, capture: Any, tmp_path: Path) -> None:
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--report", "--json")
    assert done.code == 0, done
    report = json.loads(done.out)
    files = {"page": "dial.html", "rendering": "dial_rendering.png", "adapting": "dial_adapting.png"}
    assert report["outputs"].items() >= files.items() and all((tmp_path / f).is_file() for f in files.values())
    page = stored(tmp_path / "dial.html")
    assert page["report"]["rows"] == report["rows"] and page["report"]["base_rows"] == report["base_rows"]
    curves = page["training"]["curves"]
    assert [curve["label"] for curve in curves] == ["s = 1", "s = 3", "s = 4"]
    for curve, dial in zip(curves, (1, 3, 4), strict=True):
        seconds = [point["seconds"] for point in curve["points"]]
        assert seconds == sorted(seconds) and len(seconds) == 5  # steps 1, 2, 4, 8 and 16, the end
        (row,) = [row for row in report["rows"] if row["virtual_scale"] == dial]
        assert curve["points"][-1]["psnr"] == row["psnr"]
    trained = report["seconds"]["start"] + report["seconds"]["train"]
    assert curves[0]["points"][-1]["seconds"] == pytest.approx(trained, abs=0.05)
    text = (tmp_path / "dial.html").read_text(encoding="utf-8")
    assert "change no pixel of" in text and page["report"]["plan"] == report["plan"]
    assert text.count("<svg") == 4 and "base.ply, a trained splat of 300 Gaussians" in text
    assert text.count('data-name=""') == pages.FRAMES and text.count('data-name="base"') == 1


def test_page_without_photographs(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clod_adapter.training.camera_placement.WIDTH", 62)
    monkeypatch.setattr("clod_adapter.training.camera_placement.HEIGHT", 46)
    done = clod(capture.ply, *TINY, "--report", "--json")
    assert done.code == 0, done
    report, text = json.loads(done.out), (tmp_path / "dial.html").read_text(encoding="utf-8")
    shown = re.sub(r"<script.*?</script>|<style.*?</style>|data:[^\"]*", "", text, flags=re.S)
    assert report["scene"] is None and report["outputs"]["page"] == "dial.html"
    assert "steps on synthetic views" in shown and "hold for base" in shown
    before_the_notes = shown[: shown.index("Settings and machine")]
    assert re.findall(r"\S+ photograph", before_the_notes) == ["without photograph"]
    assert text.count('data-name="photograph"') == 0 and text.count('data-name="base"') == 1
    # Twice for each of its two images, and in the table; the charts do not show the base.
    assert shown.count("base, unadapted") == 5
    assert stored(tmp_path / "dial.html")["training"]["base_psnr"] > 50


@pytest.mark.parametrize("lr", [0.0, 1e-3])
def test_snapshots_do_not_change_with_the_training(lr: float) -> None:
    """A copy holds the values of its time, the higher SH degrees included where they are trained."""
    base, scene = small_capture()
    page = pages.AdaptPage(base, scene, AdaptConfig(iters=8, lr_shN=lr), Console(quiet=True))
    result = adapt(base, scene, page.config, page).gaussians
    first, last = page.snapshots[0][1], page.snapshots[-1][1]
    changed = {name for name, value in first.tensors().items() if not value.equal(last.tensors()[name])}
    assert {"means", "sh0", "sigma_d", "opacity_logits"} <= changed and ("shN" in changed) == (lr > 0)
    whole = all(value.equal(result.tensors()[name]) for name, value in last.tensors().items())
    assert whole == (page.snapshots[-1][0] == page.trained)


def test_eval(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    done = clod("eval", dialled, "--images", capture.scene, "--report", "look.html", "--json", "--base", capture.ply)
    report = json.loads(done.out)
    assert done.code == 0 and report["outputs"] == {"page": "look.html", "rendering": "look_rendering.png"}, done
    page = stored(tmp_path / "look.html")
    assert page["report"]["rows"] == report["rows"] and page["training"] is None
    text = (tmp_path / "look.html").read_text(encoding="utf-8")
    assert 'data-name="base"' in text and "hold for base" in text
    plain = clod("eval", capture.ply, "--images", capture.scene, "--sv", 1, "--report", "plain.html")
    text = (tmp_path / "plain.html").read_text(encoding="utf-8")
    assert plain.code == 0 and "It reaches" in text and "<input" not in text  # no dial, no slider


def test_interrupt_of_the_page_keeps_the_other_files(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pages, "pictures", pressing(pages.pictures, signal.SIGINT))
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--report", "--json")
    report = json.loads(done.out)
    assert done.code == 0 and report["rows"] and "the page was interrupted and not written" in report["notes"]
    assert names(tmp_path) == OUTPUTS


def test_unusable_page_is_refused_before_reading(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = ("--images", capture.scene)
    for name, words in (("dial_adapting.png", (capture.ply, *scene, *TINY, "--report")),
                        ("page_rendering.png", ("eval", capture.ply, *scene, "--report", "page.html"))):  # fmt: skip
        (tmp_path / name / "mine").mkdir(parents=True)
        done = clod(*words)
        assert done.code == 2 and f"{name}: is a folder" in done.err and done.err.count("\n") == 1, done
        shutil.rmtree(tmp_path / name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for words in ((capture.ply, *scene, *TINY, "--report"), ("eval", capture.ply, *scene, "--report", "page.html")):
        done = clod(*words)
        assert done.code == 2 and "pip install matplotlib" in done.err
    assert list(tmp_path.iterdir()) == []
