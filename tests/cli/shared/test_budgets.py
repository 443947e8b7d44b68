"""Budgets on the command line: ``eval`` and ``export`` with --keep, --fps and --psnr-drop."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli import view
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared import measure as budgets
from clod_adapter.cli.shared.command import DEVICES
from clod_adapter.io.checkpoint import load, save
from runs import notes_of


def stored(path: Path) -> clod_adapter.Calibration:
    calibration = load(path).calibration
    assert calibration is not None
    return calibration


def with_times(source: Path, path: Path, **changes: Any) -> Path:
    """The same file with frame times of 8/s ms; ``changes`` are those of the calibration."""
    model, table = load(source), stored(source)
    rows = tuple(replace(row, frame_ms=8 / row.virtual_scale) for row in table.rows)
    save(path, model.gaussians, model, calibration=replace(table, rows=rows, **changes))
    return path


def test_eval_keeps_the_requested_count(clod: Any, capture: Any, dialled: Path) -> None:
    rows = stored(dialled).rows
    middle = round(rows[0].kept * 0.4 + rows[-1].kept * 0.6)
    done = clod("eval", dialled, "--images", capture.scene, "--keep", middle, 300, "--json")
    report = json.loads(done.out)
    assert report["rows"][0]["kept"] == middle and report["rows"][1]["virtual_scale"] == 1
    first, second = notes_of(report)
    s = report["rows"][0]["virtual_scale"]
    assert first == f"--keep {middle}: s = {s:.5g}" and 1 < s < 4 and first in done.err
    assert second == f"--keep 300: s = 1 (s = 1 keeps {rows[0].kept:,.0f} of 300 already)"


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

    def times(gaussians: Any, cameras: Any, progress: Any) -> tuple[list[tuple[float, float]], list[str]]:
        seen.append(len(cameras))
        return [(1.0, 8.0), (2.0, 4.0), (4.0, 2.0)], ["rough"]

    monkeypatch.setattr(budgets, "frame_times", times)
    report = json.loads(clod("eval", dialled, "--images", capture.scene, "--fps", 250, 10, "--json").out)
    assert [row["virtual_scale"] for row in report["rows"]] == [2, 1] and seen == [2]
    assert notes_of(report) == [
        "frames timed here: 8.0 ms at s = 1, 2.0 ms at s = 4",
        "rough",
        "--fps 250: s = 2",
        "--fps 10: s = 1 (s = 1 draws 125 frames a second already)",
    ]


def test_error_names_an_unusable_calibration(clod: Any, dialled: Path, tmp_path: Path) -> None:
    data = dialled.read_bytes().replace(b"calibrated_with 300 ", b"calibrated_with 299 ")
    extra = b"element face 0\nproperty list uchar int vertex_indices\nend_header"  # makes another note
    (tmp_path / "other.ply").write_bytes(data.replace(b"end_header", extra, 1))
    done = clod("export", "other.ply", "--psnr-drop", 1, "-o", "x.ply")
    said = "other.ply: --psnr-drop: the calibration is of 299 Gaussians and ignored, these are 300; adapt"
    assert done.code == 2 and said in done.err and "not carried over" in done.err


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


def test_device_presets_are_counts(
    clod: Any, capture: Any, dialled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For export the count of the file, for view and a page the dial value that they open at."""
    assert [*DEVICES] == ["quest3", "phone", "laptop", "desktop"] and sorted(DEVICES.values()) == [*DEVICES.values()]
    report = json.loads(clod("export", dialled, "--device-preset", "quest3", "-o", "all.ply", "--json").out)
    assert report["outputs"][0]["virtual_scale"] == 1  # it has fewer
    monkeypatch.setitem(DEVICES, "quest3", 200)
    report = json.loads(clod("export", dialled, "--device-preset", "quest3", "-o", "few.ply", "--json").out)
    assert report["outputs"][0]["count"] == 200 == len(clod_adapter.load(tmp_path / "few.ply").gaussians)
    (note,) = [note for note in report["notes"] if "preset" in note]
    assert note.startswith("--device-preset quest3, --keep 200: s = ")
    words = [str(dialled), "--images", str(capture.scene), "--device-preset", "quest3"]
    answers, report = view.make_page(build_parser("view").parse_args(words), view.Console(True))
    page = b"".join(answers["/"].blocks()).decode()
    opening = float(re.findall(r'"virtual_scale": ([\d.]+)}', page)[-1])
    model = clod_adapter.load(dialled).gaussians
    scene = clod_adapter.load_scene(capture.scene)
    kept = [int(clod_adapter.render(model, each.camera, opening).kept.sum()) for each in scene.train + scene.test]
    assert sum(kept) / len(kept) == pytest.approx(200, abs=1) and any("quest3" in note for note in report["notes"])
    for refused in (("view", capture.ply), ("export", capture.ply, "-o", "x.ply")):
        done = clod(*refused, "--device-preset", "phone")
        assert done.code == 2 and "has no sigma_d, which --device-preset" in done.err, done
    assert "not allowed with" in clod("view", dialled, "--sv", 2, "--device-preset", "phone").err
