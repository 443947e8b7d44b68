"""Budgets on the command line: ``eval``, ``render`` and ``export`` with --keep, --fps and --psnr-drop."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import clod_adapter
from clod_adapter.cli.shared import budgets
from clod_adapter.distances import normalized_distances
from clod_adapter.extinction import extinction_scale
from clod_adapter.io.checkpoint import load, save


def stored(path: Path) -> clod_adapter.Calibration:
    calibration = load(path).calibration
    assert calibration is not None
    return calibration


def notes_of(report: Any) -> list[str]:
    """Without the one on LPIPS and FLIP, which depends on what is installed."""
    return [note for note in report["notes"] if not note.startswith("without ")]


def with_times(source: Path, path: Path, **changes: Any) -> Path:
    """The same file with frame times of 8/s ms, taken as ``changes`` say."""
    model, table = load(source), stored(source)
    rows = tuple(replace(row, frame_ms=8 / row.virtual_scale) for row in table.rows)
    save(path, model.gaussians, model, calibration=replace(table, rows=rows, **changes))
    return path


def test_eval_keeps_what_was_asked_for(clod: Any, capture: Any, dialled: Path) -> None:
    rows = stored(dialled).rows
    middle = round(rows[0].kept * 0.4 + rows[-1].kept * 0.6)
    done = clod("eval", dialled, "--images", capture.scene, "--keep", middle, 300, "--json")
    report = json.loads(done.out)
    assert report["rows"][0]["kept"] == middle and report["rows"][1]["virtual_scale"] == 1
    first, second = notes_of(report)
    s = report["rows"][0]["virtual_scale"]
    assert first == f"--keep {middle}: s = {s:.5g}" and 1 < s < 4 and first in done.err
    assert second == f"--keep 300: s = 1 (s = 1 keeps {rows[0].kept:,.0f} of 300 already)"


def test_eval_refuses_what_is_out_of_reach(clod: Any, capture: Any, dialled: Path) -> None:
    for words, said in (
        (("--keep", 1), rf"--keep 1: .*at s = 4, .* {stored(dialled).rows[-1].kept:.0f} are kept$"),
        (("--fps", 10**7), r"--fps 1e\+07: .*at s = 4, .* a frame takes \S+ ms"),
    ):
        done = clod("eval", dialled, "--images", capture.scene, *words)
        assert done.code == 2 and done.out == "" and re.search(said, done.err.splitlines()[-1]), done


def test_eval_at_a_psnr_drop(clod: Any, capture: Any, dialled: Path) -> None:
    rows = stored(dialled).rows
    drop = rows[0].psnr - rows[2].psnr
    assert drop > 0.01
    report = json.loads(clod("eval", dialled, "--images", capture.scene, "--psnr-drop", drop, 90, "--json").out)
    (found, last), psnr = report["rows"], rows[0].psnr
    assert found["virtual_scale"] == pytest.approx(rows[2].virtual_scale) and last["virtual_scale"] == 4
    assert (
        psnr - found["psnr"] == pytest.approx(drop, abs=0.02) and "largest dial value measured" in notes_of(report)[1]
    )


def test_eval_times_frames_for_a_frame_rate(
    clod: Any, capture: Any, dialled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    def times(gaussians: Any, cameras: Any, progress: Any) -> list[tuple[float, float]]:
        seen.append(len(cameras))
        return [(1.0, 8.0), (2.0, 4.0), (4.0, 2.0)]

    monkeypatch.setattr(budgets, "frame_times", times)
    report = json.loads(clod("eval", dialled, "--images", capture.scene, "--fps", 250, 10, "--json").out)
    assert [row["virtual_scale"] for row in report["rows"]] == [2, 1] and seen == [2]
    assert notes_of(report) == [
        "frames timed here: 8.0 ms at s = 1, 2.0 ms at s = 4",
        "--fps 250: s = 2",
        "--fps 10: s = 1 (s = 1 draws 125 frames a second already)",
    ]


def test_an_unusable_calibration_is_the_reason_given(clod: Any, dialled: Path, tmp_path: Path) -> None:
    data = dialled.read_bytes().replace(b"calibrated_with 300 ", b"calibrated_with 299 ")
    extra = b"element face 0\nproperty list uchar int vertex_indices\nend_header"  # a note of its own, after it
    (tmp_path / "other.ply").write_bytes(data.replace(b"end_header", extra, 1))
    done = clod("export", "other.ply", "--psnr-drop", 1, "-o", "x.ply")
    said = "other.ply: --psnr-drop: the calibration is of 299 Gaussians and ignored, these are 300; adapt"
    assert done.code == 2 and said in done.err and "not carried over" in done.err


def test_render_writes_a_picture_for_each_held_out_view(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
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


def test_notes_of_a_rendering(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """Of a missing photograph, and of a dial value beyond the trained ones, which export notes, too."""
    shutil.copytree(capture.scene, tmp_path / "fewer")
    (tmp_path / "fewer" / "images" / "003.png").unlink()
    beyond = "trained up to s = 4; larger dial values were not trained"
    report = json.loads(clod("render", dialled, "--images", "fewer", "-o", "out", "--sv", 4.5, "--json").out)
    assert len(report["notes"]) == 2 and beyond in report["notes"], report
    assert any("missing and left out (003.png)" in note for note in report["notes"]), report
    assert json.loads(clod("export", dialled, "-o", "x.ply", "--sv", 4.5, "--json").out)["notes"] == [beyond]


def test_interrupted_rendering_leaves_what_is_finished(
    clod: Any, capture: Any, dialled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from clod_adapter.cli import render as command

    real = command.write_png

    def write(path: Path, pixels: Any) -> None:
        if path.name == "008.png":
            raise KeyboardInterrupt
        real(path, pixels)

    monkeypatch.setattr(command, "write_png", write)
    done = clod("render", dialled, "--images", capture.scene, "-o", "out", "--json")
    assert done.code == 0 and json.loads(done.out)["interrupted"] is True
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["000.png"]
    assert clod("render", dialled, "--images", capture.scene, "-o", "none", "--views", "008").code == 130


def test_names_that_would_collide_keep_their_suffix(capture: Any) -> None:
    from clod_adapter.cli.render import image_names

    view = clod_adapter.load_scene(capture.scene).test[0]

    def of(*names: str) -> list[str]:
        return [str(p) for p in image_names([replace(view, camera=replace(view.camera, name=name)) for name in names])]

    assert of("a.jpg", "b/a.jpg", "c\\a.JPG") == ["a.png", "b/a.png", "c/a.png"]
    assert of("a.jpg", "a.png") == ["a.jpg.png", "a.png.png"]


def test_baking_to_a_budget(clod: Any, dialled: Path, tmp_path: Path) -> None:
    def baked(*words: object) -> Any:
        report = json.loads(clod("export", *words, "--json").out)
        return report, report["outputs"][0]

    model = load(dialled)
    n = sum(len(clod_adapter.bake(model.gaussians, s, cameras=model.viewpoints)) for s in (1.0, 4.0)) // 2
    assert baked(dialled, "--keep", n, "-o", "n.ply")[1]["count"] == n == len(load("n.ply").gaussians)
    there = with_times(dialled, tmp_path / "there.ply", machine="another", width=640, height=480)
    report, output = baked(there, "--fps", 250, "-o", "f.ply")
    assert output["virtual_scale"] == pytest.approx(2)
    assert report["notes"] == ["--fps 250: s = 2 (frame times of another at 640x480)"]
    done = clod("export", there, "--fps", 10**6, "-o", "g.ply")
    assert done.code == 2 and done.err.rstrip().endswith("500 a second (frame times of another at 640x480)")
    assert not (tmp_path / "g.ply").exists()
    rows = stored(dialled).rows
    output = baked(dialled, "--psnr-drop", rows[0].psnr - rows[2].psnr, "-o", "p.ply")[1]
    assert output["virtual_scale"] == pytest.approx(rows[2].virtual_scale)
