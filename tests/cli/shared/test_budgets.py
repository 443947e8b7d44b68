"""Budgets on the command line: ``eval`` and ``export`` with --keep, --fps and --psnr-drop."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli import view
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared.command import DEVICES
from clod_adapter.io.checkpoint import load, save


def stored(path: Path) -> clod_adapter.Calibration:
    calibration = load(path).calibration
    assert calibration is not None
    return calibration


def test_eval_at_a_budget(clod: Any, capture: Any, dialled: Path) -> None:
    """Within the range, at s = 1 if that is enough; a psnr drop out of reach gives the range's end; with notes."""
    rows = stored(dialled).rows
    middle, drop = round(rows[0].kept * 0.4 + rows[-1].kept * 0.6), rows[0].psnr - rows[2].psnr

    def at(*words: object) -> tuple[list[Any], list[str]]:
        report = json.loads(clod("eval", dialled, "--images", capture.scene, *words, "--json").out)
        return report["rows"], report["notes"]

    (found, whole), notes = at("--keep", middle, 300)
    s = found["virtual_scale"]
    assert found["kept"] == middle and 1 < s < 4 and whole["virtual_scale"] == 1
    assert notes == [
        f"--keep {middle}: s = {s:.5g}", f"--keep 300: s = 1 (s = 1 keeps {rows[0].kept:,.0f} of 300 already)"
    ]  # fmt: skip
    (found, last), notes = at("--psnr-drop", drop, 90)
    assert found["virtual_scale"] == pytest.approx(rows[2].virtual_scale) and last["virtual_scale"] == 4
    assert rows[0].psnr - found["psnr"] == pytest.approx(drop, abs=0.02) and "largest dial value measured" in notes[1]
    (slow,), notes = at("--fps", 1)
    assert slow["virtual_scale"] == 1 and re.match(r"frames timed here: \S+ ms at s = 1, \S+ ms at s = 4", notes[0])
    assert re.match(r"--fps 1: s = 1 \(s = 1 draws \d+ frames a second already\)", notes[-1])


def test_baking_to_a_budget(clod: Any, dialled: Path) -> None:
    def baked(*words: object) -> Any:
        report = json.loads(clod("export", *words, "--json").out)
        return report, report["outputs"][0]

    model, table = load(dialled), stored(dialled)
    n = sum(len(clod_adapter.bake(model.gaussians, s, cameras=model.viewpoints)) for s in (1.0, 4.0)) // 2
    assert baked(dialled, "--keep", n, "-o", "n.ply")[1]["count"] == n == len(load("n.ply").gaussians)
    rows = tuple(replace(row, frame_ms=8 / row.virtual_scale) for row in table.rows)
    elsewhere = replace(table, rows=rows, machine="another", width=640, height=480)
    save("there.ply", model.gaussians, model, calibration=elsewhere)
    report, output = baked("there.ply", "--fps", 250, "-o", "f.ply")
    assert output["virtual_scale"] == pytest.approx(2)
    assert report["notes"] == ["--fps 250: s = 2 (frame times of another at 640x480)"]
    done = clod("export", "there.ply", "--fps", 10**6, "-o", "g.ply")
    assert done.code == 2 and done.err.rstrip().endswith("500 a second (frame times of another at 640x480)")
    output = baked(dialled, "--psnr-drop", rows[0].psnr - rows[2].psnr, "-o", "p.ply")[1]
    assert output["virtual_scale"] == pytest.approx(rows[2].virtual_scale)


def test_device_presets_are_counts(
    clod: Any, capture: Any, dialled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For export the count of the file, for view and a page the dial value that they open at."""
    assert [*DEVICES] == ["quest3", "phone", "laptop", "desktop"] and sorted(DEVICES.values()) == [*DEVICES.values()]
    monkeypatch.setitem(DEVICES, "quest3", 200)
    report = json.loads(clod("export", dialled, "--device-preset", "quest3", "-o", "few.ply", "--json").out)
    assert report["outputs"][0]["count"] == 200 == len(clod_adapter.load(tmp_path / "few.ply").gaussians)
    (note,) = [note for note in report["notes"] if "preset" in note]
    assert note.startswith("--device-preset quest3, --keep 200: s = ")
    words = [str(dialled), "--images", str(capture.scene), "--device-preset", "quest3"]
    answers, report = view.make_page(build_parser("view").parse_args(words), view.Console(True))
    page = b"".join(answers["/"].blocks()).decode()
    opening = float(re.findall(r'"virtual_scale": ([\d.]+)}', page)[-1])
    model, scene = clod_adapter.load(dialled).gaussians, clod_adapter.load_scene(capture.scene)
    kept = [int(clod_adapter.render(model, each.camera, opening).kept.sum()) for each in scene.train + scene.test]
    assert sum(kept) / len(kept) == pytest.approx(200, abs=1) and any("quest3" in note for note in report["notes"])
