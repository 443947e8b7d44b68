"""``clod-adapt render``: images, selected views, notes, interrupts."""

import json
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import clod_adapter
from clod_adapter.cli import render as command
from clod_adapter.io.checkpoint import load
from runs import pressing


def rendered(clod: Any, *words: object) -> tuple[Any, str]:
    """The report, and what was printed."""
    done = clod("render", *words, "--json")
    assert done.code == 0, done
    return json.loads(done.out), done.err


def test_an_image_per_view(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """Of the held-out views, of all, or of one, for which a count is solved."""
    there = (dialled, "--images", capture.scene)
    report, err = rendered(clod, *there, "-o", "out/here", "--sv", 1, 3, "--beside")
    assert report["virtual_scales"] == [1, 3] and not report["interrupted"]
    files = sorted(path.name for path in (tmp_path / "out" / "here").iterdir())
    assert files == ["000.png", "008.png"] == [Path(picture["file"]).name for picture in report["pictures"]]
    scene, gaussians = clod_adapter.load_scene(capture.scene), load(dialled).gaussians
    for view, picture in zip(scene.test, report["pictures"], strict=True):
        pixels = np.asarray(Image.open(picture["file"]))
        assert pixels.shape == (48, 3 * 64, 3) and (pixels[:, :64] == view.image.numpy()).all()
        for k, s in enumerate((1.0, 3.0)):
            want = clod_adapter.render(gaussians, view.camera, s)
            shown = pixels[:, 64 * (k + 1) : 64 * (k + 2)]
            assert np.abs(shown - 255 * want.image.clamp(0, 1).numpy()).max() <= 0.51
            assert picture["kept"][k] == want.kept.sum()
    assert re.search(r"s = 3: [\d.]+ of 300 Gaussians, \d+\.\d\d dB", err), err
    n = report["pictures"][0]["kept"][1]
    report, _ = rendered(clod, *there, "-o", "one", "--views", "000", "--keep", n)
    assert [p["view"] for p in report["pictures"]] == ["000.png"] and report["pictures"][0]["kept"] == [n]
    report, _ = rendered(clod, *there, "-o", "all", "--views", "all")
    assert [p["view"] for p in report["pictures"]] == [f"{k:03}.png" for k in range(10)]
    assert report["virtual_scales"] == [1] and len(list((tmp_path / "all").iterdir())) == 10


def test_notes(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """On a missing photograph, and a dial value beyond the trained ones."""
    shutil.copytree(capture.scene, tmp_path / "fewer")
    (tmp_path / "fewer" / "images" / "003.png").unlink()
    report, _ = rendered(clod, dialled, "--images", "fewer", "-o", "out", "--sv", 4.5)
    missing, beyond = report["notes"]
    assert "missing and left out (003.png)" in missing
    assert beyond == "trained up to s = 4; larger dial values were not trained"


@pytest.mark.parametrize("presses", [1, 2])
def test_interrupts(
    clod: Any, capture: Any, dialled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, presses: int
) -> None:
    """After one the image under way is finished; two abort."""
    monkeypatch.setattr(command, "write_png", pressing(command.write_png, *[signal.SIGINT] * presses))
    done = clod("render", dialled, "--images", capture.scene, "-o", "out", "--json")
    written = [path.name for path in tmp_path.glob("out/*")]
    assert done.code == (0 if presses == 1 else 130) and written == ["000.png"][: 2 - presses], done
    assert presses == 2 or json.loads(done.out)["interrupted"] is True


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (("a.jpg", "b/a.jpg", "c\\a.JPG"), ["a.png", "b/a.png", "c/a.png"]),
        (("a.jpg", "a.png"), ["a.jpg.png", "a.png.png"]),  # equal without their suffixes
    ],
)
def test_image_names(capture: Any, names: tuple[str, ...], files: list[str]) -> None:
    view = clod_adapter.load_scene(capture.scene).test[0]
    views = [replace(view, camera=replace(view.camera, name=name)) for name in names]
    assert [str(path) for path in command.image_names(views)] == files
