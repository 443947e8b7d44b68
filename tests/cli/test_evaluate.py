"""``clod-adapt eval``: its rows, and its comparisons: pruned base, other files, popping, more metrics."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
from clod_adapter.evaluation import evaluate as module
from runs import notes_of, pressing

ROW = {"virtual_scale", "psnr", "ssim", "kept", "kept_share", "in_view", "frame_ms"}


def test_eval_prints_one_object(clod: Any, capture: Any, dialled: Path) -> None:
    done = clod("eval", dialled, "--images", capture.scene, "--sv", "1", "2.5", "--json")
    assert done.code == 0 and done.out.count("\n") == 1, done
    report = json.loads(done.out)
    assert (report["model"], report["scene"], report["base_count"]) == (str(dialled), str(capture.scene), 300)
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2.5]
    for row in report["rows"]:
        assert set(row) == ROW and row["in_view"] <= row["kept"]
        assert row["kept_share"] == row["kept"] / 300 and row["frame_ms"] > 0
        assert 0 < row["psnr"] < 100 and 0 < row["ssim"] <= 1
    assert "PSNR dB" in done.err and "PSNR dB" not in done.out


def test_eval_of_a_plain_file(clod: Any, capture: Any) -> None:
    done = clod("eval", capture.ply, "--images", capture.scene, "--popping", "--json")
    report = json.loads(done.out)
    assert report["popping"] == [] and any("popping is not measured" in note for note in report["notes"])
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2, 3, 5]
    assert {row["kept_share"] for row in report["rows"]} == {1.0} and len({row["psnr"] for row in report["rows"]}) == 1
    assert report["attenuation"] is None and "has no sigma_d" in done.err
    shown = clod("eval", capture.ply, "--images", capture.scene, "--quiet")
    assert len(shown.out.splitlines()) == 5 and shown.err == ""


def test_default_dial_values_are_within_the_trained_range(clod: Any, capture: Any) -> None:
    for max_sv, dials in ((2.5, [1, 2, 2.5]), (1, [1]), (7, [1, 2, 3, 5, 7])):
        sigma = torch.linspace(0.5, 5, 300)
        model = clod_adapter.with_dial(capture.gaussians, sigma, clod_adapter.AttenuationConfig(max_sv=max_sv))
        clod_adapter.save("dial.ply", model)
        report = json.loads(clod("eval", "dial.ply", "--images", capture.scene, "--json").out)
        assert [row["virtual_scale"] for row in report["rows"]] == dials and notes_of(report) == []
    done = clod("eval", "dial.ply", "--images", capture.scene, "--sv", 8, "--json")
    (note,) = notes_of(json.loads(done.out))
    assert note.startswith("trained up to s = 7") and note in done.err


def test_base_by_rank(clod: Any, capture: Any, dialled: Path) -> None:
    done = clod("eval", dialled, "--images", capture.scene, "--sv", 1, 4, "--base", capture.ply, "--json")
    report = json.loads(done.out)
    assert report["base"] == str(capture.ply) and report["base_row"]["kept"] == 300 and report["interrupted"] is False
    assert [(entry["virtual_scale"], entry["by"]) for entry in report["ranked"]] == [
        (s, by) for s in (1, 4) for by in ("opacity", "removal error")
    ]
    kept = {row["virtual_scale"]: row["kept"] for row in report["rows"]}
    assert [entry["row"]["kept"] for entry in report["ranked"]] == [round(kept[s]) for s in (1, 1, 4, 4)]
    assert all(entry["row"]["kept_share"] == entry["row"]["kept"] / 300 for entry in report["ranked"])
    base, views = clod_adapter.load(capture.ply).gaussians, clod_adapter.load_scene(capture.scene).test
    top = base.opacity_logits.argsort(descending=True)[: round(kept[4])]
    (want,) = clod_adapter.evaluate(base.select(top), views, [1.0])
    assert report["ranked"][2]["row"]["psnr"] == pytest.approx(want.psnr, abs=1e-4)
    block = done.err[done.err.index("pruned to the same counts") :].splitlines()[2:]
    by = ["opacity", "removal"]  # and error
    assert [line.split()[0] for line in block[:7]] == ["base", "s=1", *by, "s=4", *by]
    assert report["against"] == [] and report["popping"] == []


def test_against_at_matched_counts(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    shown = json.loads(clod("eval", dialled, "--images", capture.scene, "--sv", 1, 4, "--json").out)["rows"]
    count = round((shown[0]["kept"] + shown[1]["kept"]) / 2)  # within the dial's reach
    few = capture.write(tmp_path / "few.ply", capture.gaussians.select(torch.arange(count)))
    words = ("eval", dialled, "--images", capture.scene, "--sv", 1, 2, "--json", "--against", few, capture.ply, dialled)
    done = clod(*words)
    report = json.loads(done.out)
    pairs = [(Path(e["model"]).name, e["theirs"]["kept"], e["ours"]["kept"]) for e in report["against"]]
    assert [name for name, *_ in pairs] == ["few.ply", capture.ply.name, "dial.ply", "dial.ply"]
    assert pairs[0][1] == count == pytest.approx(pairs[0][2], abs=1)
    assert pairs[1][1] == 300 > pairs[1][2] == report["rows"][0]["kept"]
    (note,) = [note for note in report["notes"] if "keeps 300 Gaussians" in note]
    assert note in done.err and "at most" in note
    for own, row in zip(report["against"][2:], report["rows"], strict=True):  # compared with itself
        assert own["theirs"]["psnr"] == row["psnr"] and own["ours"]["kept"] == pytest.approx(row["kept"], rel=2e-3)
    assert "the dial value with the same count" in done.err


def test_against_files_of_one_name(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    paths = []
    for name, count in (("a", 60), ("b", 90)):
        (tmp_path / name).mkdir()
        few = capture.gaussians.select(torch.arange(count))
        paths.append(capture.write(tmp_path / name / "point_cloud.ply", few))
    words = ("eval", dialled, "--images", capture.scene, "--sv", 1, "--json", "--against")
    report = json.loads(clod(*words, *paths, "--report", "page.html").out)
    assert [entry["label"] for entry in report["against"]] == ["a_point_cloud", "b_point_cloud"]
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert all(f'"label": "{name}_point_cloud"' in text for name in "ab")
    twice = clod(*words, paths[0], paths[1], paths[0])
    assert twice.code == 2 and "point_cloud.ply: is given twice" in twice.err and "\n" not in twice.err.strip()


def test_popping(clod: Any, capture: Any, dialled: Path) -> None:
    done = clod("eval", dialled, "--images", capture.scene, "--sv", 1, 3, "--popping", "--json")
    dial, other, walk = json.loads(done.out)["popping"]
    assert (dial["moved"], other["moved"]) == ("dial, 000.png", "dial, 008.png")
    assert walk["moved"] == "camera, 002.png to 006.png, s = 3"
    for entry in (dial, other, walk):
        assert entry["steps"] == len(entry["changes"]) == 200
        assert entry["largest"] == max(entry["changes"]) and 1 < entry["ratio"] < 200
        assert 0.3 < entry["persistence"] <= 1 and entry["largest"] < entry["pixel"] < 255
    assert 1 < dial["at"] <= 3 and 0 < walk["at"] <= 1
    assert re.search(r"^ +steps +mean", done.err, re.M) and "\ncamera, 002.png to 006.png, s = 3\n" in done.err


def test_interrupt_keeps_finished_comparisons(
    clod: Any, capture: Any, dialled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "evaluate", pressing(module.evaluate, signal.SIGINT, at=3))
    words = ("eval", dialled, "--images", capture.scene, "--sv", 1, 2, "--base", capture.ply, "--popping", "--json")
    done = clod(*words)
    report = json.loads(done.out)
    assert done.code == 0 and report["interrupted"] is True and len(report["rows"]) == 2
    assert report["base_row"] and [entry["by"] for entry in report["ranked"]] == ["opacity"]
    assert report["popping"] == []
