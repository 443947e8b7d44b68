"""``clod-adapt render``: images, selected views, notes, interrupts."""

from __future__ import annotations

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
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.extinction import extinction_scale
from clod_adapter.io.checkpoint import load
from runs import pressing


def test_render_writes_an_image_per_held_out_view(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    done = clod("render", dialled, "--images", capture.scene, "-o", "out/here", "--sv", 1, 3, "--beside", "--json")
    report = json.loads(done.out)
    assert done.code == 0 and report["virtual_scales"] == [1, 3] and not report["interrupted"]
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
    assert re.search(r"s = 3: [\d.]+ of 300 Gaussians, \d+\.\d\d dB", done.err), done


def test_render_picks_views_and_solves_for_them(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    name = "003"
    words = ("render", dialled, "--images", capture.scene, "-o", "one", "--views", name, "--json")
    camera = next(v.camera for v in clod_adapter.load_scene(capture.scene).train if v.camera.name == "003.png")
    g = load(dialled).gaussians
    assert g.sigma_d is not None and g.attenuation is not None
    distances = normalized_distances(g.means, camera, g.attenuation)
    n = int((extinction_scale(g.opacity_logits, g.sigma_d, distances, g.attenuation) > 2).sum())
    report = json.loads(clod(*words, "--keep", n).out)
    assert [p["view"] for p in report["pictures"]] == ["003.png"] and report["pictures"][0]["kept"] == [n]
    assert [path.name for path in (tmp_path / "one").iterdir()] == ["003.png"]
    every = json.loads(clod("render", dialled, "--images", capture.scene, "-o", "all", "--views", "all", "--json").out)
    assert [p["view"] for p in every["pictures"]] == [f"{k:03}.png" for k in range(10)]
    assert every["virtual_scales"] == [1] and len(list((tmp_path / "all").iterdir())) == 10


def test_notes_of_render(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """On a missing photograph, and on a dial value beyond the trained ones, as in export."""
    shutil.copytree(capture.scene, tmp_path / "fewer")
    (tmp_path / "fewer" / "images" / "003.png").unlink()
    beyond = "trained up to s = 4; larger dial values were not trained"
    report = json.loads(clod("render", dialled, "--images", "fewer", "-o", "out", "--sv", 4.5, "--json").out)
    assert len(report["notes"]) == 2 and beyond in report["notes"], report
    assert any("missing and left out (003.png)" in note for note in report["notes"]), report
    assert json.loads(clod("export", dialled, "-o", "x.ply", "--sv", 4.5, "--json").out)["notes"] == [beyond]


def test_a_dial_value_of_a_plain_file_is_noted(clod: Any, capture: Any) -> None:
    done = clod("render", capture.ply, "--images", capture.scene, "-o", "out", "--sv", 1, 3, "--json")
    report = json.loads(done.out)
    assert f"{capture.ply} has no sigma_d, so every dial value renders all of it" in report["notes"]
    assert report["pictures"][0]["kept"] == [300, 300] and "Warning" not in done.err


@pytest.mark.parametrize("presses", [1, 2])
def test_interrupts_of_rendering(
    clod: Any, capture: Any, dialled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, presses: int
) -> None:
    """After one the image under way is finished; two abort."""
    monkeypatch.setattr(command, "write_png", pressing(command.write_png, *[signal.SIGINT] * presses))
    done = clod("render", dialled, "--images", capture.scene, "-o", "out", "--json")
    written = [path.name for path in tmp_path.glob("out/*")]
    assert done.code == (0 if presses == 1 else 130) and written == ["000.png"][: 2 - presses], done
    assert presses == 2 or json.loads(done.out)["interrupted"] is True


def test_equal_image_names_keep_their_suffix(capture: Any) -> None:
    view = clod_adapter.load_scene(capture.scene).test[0]

    def of(*names: str) -> list[str]:
        return [
            str(p)
            for p in command.image_names([replace(view, camera=replace(view.camera, name=name)) for name in names])
        ]

    assert of("a.jpg", "b/a.jpg", "c\\a.JPG") == ["a.png", "b/a.png", "c/a.png"]
    assert of("a.jpg", "a.png") == ["a.jpg.png", "a.png.png"]
