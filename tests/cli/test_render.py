"""``clod-adapt render``: images, selected views, notes, interrupts."""

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
from runs import pressing

RENDER = "render DIAL --images SCENE --json -o"


def test_an_image_per_view(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """Of the held-out views, of all, or of one, for which a count is solved."""
    done = clod(RENDER, "out/here --sv 1 3 --beside")
    assert done.report["virtual_scales"] == [1, 3] and not done.report["interrupted"]
    files, pictures = sorted(path.name for path in (tmp_path / "out" / "here").iterdir()), done.report["pictures"]
    assert files == ["000.png", "008.png"] == [Path(picture["file"]).name for picture in pictures]
    scene, gaussians = clod_adapter.load_scene(capture.scene), clod_adapter.load(dialled).gaussians
    for view, picture in zip(scene.test, pictures, strict=True):
        pixels = np.asarray(Image.open(picture["file"]))
        assert pixels.shape == (48, 3 * 64, 3) and (pixels[:, :64] == view.image.numpy()).all()
        for k, s in enumerate((1.0, 3.0)):
            want = clod_adapter.render(gaussians, view.camera, s)
            shown = pixels[:, 64 * (k + 1) : 64 * (k + 2)]
            assert np.abs(shown - 255 * want.image.clamp(0, 1).numpy()).max() <= 0.51
            assert picture["kept"][k] == want.kept.sum()
    assert re.search(r"s = 3: [\d.]+ of 300 Gaussians, \d+\.\d\d dB", done.err), done
    n = pictures[0]["kept"][1]
    (picture,) = clod(RENDER, "one --views 000 --keep", n).report["pictures"]
    assert (picture["view"], picture["kept"]) == ("000.png", [n])
    report = clod(RENDER, "all --views all").report
    assert [p["view"] for p in report["pictures"]] == [f"{k:03}.png" for k in range(10)]
    assert report["virtual_scales"] == [1] and len(list((tmp_path / "all").iterdir())) == 10


def test_notes(clod: Any, capture: Any, tmp_path: Path) -> None:
    """On a missing photograph, and a dial value beyond the trained ones."""
    shutil.copytree(capture.scene, tmp_path / "fewer")
    (tmp_path / "fewer" / "images" / "003.png").unlink()
    missing, beyond = clod("render DIAL --images fewer --json -o out --sv 4.5").report["notes"]
    assert "missing and left out (003.png)" in missing
    assert beyond == "trained up to s = 4; larger dial values were not trained"


@pytest.mark.parametrize("presses", [1, 2])
def test_interrupts(clod: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, presses: int) -> None:
    """After one the image under way is finished; two abort."""
    monkeypatch.setattr(command, "write_png", pressing(command.write_png, *[signal.SIGINT] * presses))
    done = clod(RENDER, "out", code=0 if presses == 1 else 130)
    assert [path.name for path in tmp_path.glob("out/*")] == ["000.png"][: 2 - presses], done
    assert presses == 2 or done.report["interrupted"] is True


def test_image_names(capture: Any) -> None:
    """Names that are equal without their suffixes keep them."""
    view = clod_adapter.load_scene(capture.scene).test[0]
    for names, files in (
        (("ä.jpg", "b/ä.jpg", "c\\ä.JPG"), ["ä.png", "b/ä.png", "c/ä.png"]),
        (("a.jpg", "a.png"), ["a.jpg.png", "a.png.png"]),
    ):
        views = [replace(view, camera=replace(view.camera, name=name)) for name in names]
        assert [str(path) for path in command.image_names(views)] == files
