"""``clod-adapt eval``: its rows, comparisons with pruned base and other files, popping, and budgets, as of export."""

import json
import re
import signal
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
from clod_adapter.cli import view
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared import measure
from clod_adapter.cli.shared.command import DEVICES
from clod_adapter.evaluation import evaluate as module
from clod_adapter.evaluation import frame_times
from clod_adapter.evaluation.frame_times import FrameTimes, Model
from clod_adapter.io.checkpoint import load, save
from runs import pressing

ROW = {"virtual_scale", "psnr", "ssim", "kept", "kept_share", "in_view", "frame_ms"}


def measured(clod: Any, *words: object) -> tuple[Any, str]:
    done = clod("eval", *words, "--json")
    assert done.code == 0 and done.out.count("\n") == 1, done
    return json.loads(done.out), done.err


def test_rows_and_default_dial_values(clod: Any, capture: Any, dialled: Path) -> None:
    """The defaults are within the trained range; a plain file has one picture and no popping."""
    report, err = measured(clod, dialled, "--images", capture.scene)
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2, 3, 4] and report["notes"] == []
    assert (report["model"], report["scene"], report["base_count"]) == (str(dialled), str(capture.scene), 300)
    for row in report["rows"]:
        assert set(row) == ROW and row["in_view"] <= row["kept"]
        assert row["kept_share"] == row["kept"] / 300 and row["frame_ms"] > 0
        assert 0 < row["psnr"] < 100 and 0 < row["ssim"] <= 1
    assert "PSNR dB" in err
    report, err = measured(clod, dialled, "--images", capture.scene, "--sv", 8)
    assert [note.partition(";")[0] for note in report["notes"]] == ["trained up to s = 4"] and report["notes"][0] in err
    report, err = measured(clod, capture.ply, "--images", capture.scene, "--popping")
    assert report["popping"] == [] and any("popping is not measured" in note for note in report["notes"])
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2, 3, 5]
    assert {row["kept_share"] for row in report["rows"]} == {1.0} and len({row["psnr"] for row in report["rows"]}) == 1
    assert report["attenuation"] is None and "has no sigma_d" in err
    shown = clod("eval", capture.ply, "--images", capture.scene, "--quiet")
    assert len(shown.out.splitlines()) == 5 and shown.err == ""


def test_base_by_rank_and_popping(clod: Any, capture: Any, dialled: Path) -> None:
    words = (dialled, "--images", capture.scene, "--sv", 1, 4, "--base", capture.ply, "--popping")
    report, err = measured(clod, *words)
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
    by_opacity, by_error = (entry["row"]["psnr"] for entry in report["ranked"][2:])
    assert by_opacity == pytest.approx(want.psnr, abs=1e-4) and by_error > by_opacity
    block = err[err.index("pruned to the same counts") :].splitlines()[2:]
    by = ["opacity", "removal"]  # and error
    assert [line.split()[0] for line in block[:7]] == ["base", "s=1", *by, "s=4", *by] and report["against"] == []
    dial, other, walk = report["popping"]
    assert (dial["moved"], other["moved"]) == ("dial, 000.png", "dial, 008.png")
    assert walk["moved"] == "camera, 002.png to 006.png, s = 4"
    assert all(entry["steps"] == len(entry["changes"]) == 200 and entry["ratio"] > 1 for entry in report["popping"])
    assert re.search(r"^ +steps +mean", err, re.M) and "\ncamera, 002.png to 006.png, s = 4\n" in err


def test_against_at_matched_counts(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """Files of one name have their folders as labels."""
    shown = measured(clod, dialled, "--images", capture.scene, "--sv", 1, 4)[0]["rows"]
    count = round((shown[0]["kept"] + shown[1]["kept"]) / 2)  # within the dial's reach
    paths = []
    for name, size in (("a", count), ("b", 300)):
        (tmp_path / name).mkdir()
        paths.append(capture.write(tmp_path / name / "cloud.ply", capture.gaussians.select(torch.arange(size))))
    words = (dialled, "--images", capture.scene, "--sv", 1, 2, "--against", *paths, dialled)
    report, err = measured(clod, *words)
    assert [entry["label"] for entry in report["against"]] == ["a_cloud", "b_cloud", "dial", "dial"]
    pairs = [(entry["theirs"]["kept"], entry["ours"]["kept"]) for entry in report["against"]]
    assert pairs[0][0] == count == pytest.approx(pairs[0][1], abs=1)
    assert pairs[1][0] == 300 > pairs[1][1] == report["rows"][0]["kept"]
    (note,) = [note for note in report["notes"] if "keeps 300 Gaussians" in note]
    assert note in err and "at most" in note and "the dial value with the same count" in err
    for own, row in zip(report["against"][2:], report["rows"], strict=True):  # compared with itself
        assert own["theirs"]["psnr"] == row["psnr"] and own["ours"]["kept"] == pytest.approx(row["kept"], rel=2e-3)


def test_interrupt_keeps_finished_comparisons(
    clod: Any, capture: Any, dialled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "evaluate", pressing(module.evaluate, signal.SIGINT, at=3))
    words = (dialled, "--images", capture.scene, "--sv", 1, 2, "--base", capture.ply, "--popping")
    report, _ = measured(clod, *words)
    assert report["interrupted"] is True and len(report["rows"]) == 2 and report["popping"] == []
    assert report["base_row"] and [entry["by"] for entry in report["ranked"]] == ["opacity"]


def test_frames_are_timed_together(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of base, result and plain file; frames take 1000/s ms, and those of the k-th model k times that."""
    seen = list[list[int]]()

    def times(models: Sequence[Model], cameras: Any, progress: Any) -> FrameTimes:
        seen.append([len(some) for some, _ in models])
        found = tuple(tuple(1000.0 * (k + 1) / s for s in dials) for k, (_, dials) in enumerate(models))
        return FrameTimes(found, 0.5)

    monkeypatch.setattr(measure, "time_frames", times)
    monkeypatch.setattr(frame_times, "NOISY", 0.2)
    scene = ("--images", capture.scene, "--json")
    done = clod(capture.ply, *scene, "--iters", 2, "--max-sv", 4, "--out", "dial.ply")
    report, table = json.loads(done.out), clod_adapter.load("dial.ply").calibration
    assert seen == [[300, 300, 300]] and table is not None
    assert [row.frame_ms * row.virtual_scale for row in table.rows] == pytest.approx([2000] * 5)
    assert (report["base_rows"][0]["frame_ms"], report["detached_row"]["frame_ms"]) == (1000, 3000)
    assert any("frame times are rough: they varied by 50%" in note for note in report["notes"])
    assert done.err.count("frame times are rough") == 1
    rows = json.loads(clod("eval", "dial.ply", *scene, "--sv", 3, 1).out)["rows"]
    assert [(row["virtual_scale"], round(row["frame_ms"])) for row in rows] == [(3, 333), (1, 1000)]


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
