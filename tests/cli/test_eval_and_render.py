"""``clod-adapt eval``: rows, comparisons, popping, budgets, as of export; ``render``: images,
views, interrupts.
"""

import os
import re
import signal
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
from PIL import Image

from clod_adapter import evaluate, load_scene, render
from clod_adapter.cli import render as command
from clod_adapter.cli import view
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared import measure
from clod_adapter.cli.shared.command import DEVICES
from clod_adapter.evaluation import calibrate, frame_times
from clod_adapter.evaluation.frame_times import FrameTimes
from clod_adapter.io.checkpoint import load, save
from runs import names, pressing

EVAL = "eval DIAL --images SCENE --json"


def test_rows_and_default_dial_values(clod, capture, attenuated):
    """The defaults are within the trained range; a plain file has one picture and no popping."""
    done = clod(EVAL)
    report = done.report
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2, 3, 4]
    assert report["notes"] == []
    assert report["model"] == str(attenuated) and report["scene"] == str(capture.scene)
    assert report["base_count"] == 300
    for row in report["rows"]:
        assert row["in_view"] <= row["kept"] and row["frame_ms_range"] >= 0
        assert row["kept_share"] == row["kept"] / 300 and row["frame_ms"] > 0
        assert 0 < row["psnr"] < 100 and 0 < row["ssim"] <= 1
    assert "PSNR dB" in done.err and done.out.count("\n") == 1
    done = clod(EVAL, "--sv 8")
    assert done.note("trained up to s = 4;") in done.err
    done = clod("eval BASE --images SCENE --popping --json")
    report = done.report
    assert done.note("popping is not measured") and report["popping"] == []
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2, 3, 5]
    assert {row["kept_share"] for row in report["rows"]} == {1.0}
    assert len({row["psnr"] for row in report["rows"]}) == 1
    assert report["attenuation"] is None and "has no sigma_d" in done.err
    done = clod("eval BASE --images SCENE --quiet")
    assert len(done.out.splitlines()) == 5 and done.err == ""


def test_base_by_rank_and_popping(clod, capture):
    done = clod(EVAL, "--sv 1 4 --base BASE --popping")
    report = done.report
    assert report["base"] == str(capture.ply)
    assert report["base_row"]["kept"] == 300
    assert report["interrupted"] is False and report["against"] == []
    kept = {row["virtual_scale"]: round(row["kept"]) for row in report["rows"]}
    assert [(entry["virtual_scale"], entry["by"]) for entry in report["ranked"]] == [
        *product((1, 4), ("opacity", "removal error"))
    ]
    for entry in report["ranked"]:
        row = entry["row"]
        assert row["kept"] == kept[entry["virtual_scale"]]
        assert row["kept_share"] == row["kept"] / 300
    base = capture.gaussians
    top = base.opacity_logits.argsort(descending=True)[: kept[4]]
    (want,) = evaluate(base.select(top), load_scene(capture.scene).test, [1.0])
    by_opacity, by_error = (entry["row"]["psnr"] for entry in report["ranked"][2:])
    assert by_opacity == pytest.approx(want.psnr, abs=1e-4) and by_error > by_opacity
    block = done.err[done.err.index("pruned to the same counts") :].splitlines()[2:]
    by = "opacity removal"  # and error
    assert [line.split()[0] for line in block[:7]] == f"base s=1 {by} s=4 {by}".split()
    moved = ["dial, 000.png", "dial, 008.png", "camera, 002.png to 006.png, s = 4"]
    assert [entry["moved"] for entry in report["popping"]] == moved
    assert f"\n{moved[2]}\n" in done.err
    for entry in report["popping"]:
        assert entry["steps"] == len(entry["changes"]) == 200 and entry["ratio"] > 1
    assert re.search(r"^ +steps +mean", done.err, re.M)


def test_against_at_matched_counts(clod, capture, attenuated, tmp_path):
    """Files of one name have their folders as labels."""
    # within the dial's reach
    count = int(sum(row.kept for row in load(attenuated).quality_table.rows[::4]) // 2)
    for name, size in (("a", count), ("b", 300)):
        (tmp_path / name).mkdir()
        capture.write(tmp_path / name / "cloud.ply", capture.gaussians[:size])
    done = clod(EVAL, "--sv 1 2 --against a/cloud.ply b/cloud.ply DIAL")
    rows = done.report["rows"]
    few, whole, *itself = done.report["against"]
    labels = [entry["label"] for entry in done.report["against"]]
    assert labels == ["a_cloud", "b_cloud", "dial", "dial"]
    assert few["theirs"]["kept"] == count == pytest.approx(few["ours"]["kept"], abs=1)
    assert whole["theirs"]["kept"] == 300 > whole["ours"]["kept"] == rows[0]["kept"]
    note = done.note("keeps 300 Gaussians")
    assert "at most" in note in done.err
    assert "the dial value with the same count" in done.err
    for entry, row in zip(itself, rows, strict=True):
        assert entry["theirs"]["psnr"] == row["psnr"]
        assert entry["ours"]["kept"] == pytest.approx(row["kept"], rel=2e-3)


def test_interrupt_keeps_finished_comparisons(clod, monkeypatch):
    monkeypatch.setattr(measure, "evaluate", pressing(measure.evaluate, signal.SIGINT, at=4))
    report = clod(EVAL, "--sv 1 2 --base BASE --popping").report
    assert report["interrupted"] is True and len(report["rows"]) == 2 and report["popping"] == []
    assert report["base_row"] and [entry["by"] for entry in report["ranked"]] == ["opacity"]


def test_frames_are_timed_together(clod, monkeypatch):
    """Those of base, result and plain file; frames take 1000/s ms, and those of the k-th model k
    times that.
    """
    counts = []

    def times(models, cameras, progress):
        counts.append([len(gaussians) for gaussians, _ in models])
        milliseconds, ranges = [], []
        for k, (_, dials) in enumerate(models, 1):
            milliseconds.append(tuple(1000 * k / s for s in dials))
            ranges.append(tuple(500 * k / s for s in dials))
        return FrameTimes(tuple(milliseconds), tuple(ranges))

    monkeypatch.setattr(calibrate, "time_frames", times)
    monkeypatch.setattr(frame_times, "NOISY", 0.2)
    done = clod("BASE --images SCENE --iters 2 --max-sv 4 --out dial.ply --json")
    assert counts == [[300, 540, 300]]
    stored = load("dial.ply").quality_table.rows
    assert [row.frame_ms * row.virtual_scale for row in stored] == pytest.approx([2000] * 5)
    assert done.report["base_rows"][0]["frame_ms"] == 1000
    assert done.report["base_rows"][0]["frame_ms_range"] == 500
    assert done.report["detached_row"]["frame_ms"] == 3000
    assert done.note("frame times are rough: they varied by 50%")
    assert done.err.count("frame times are rough") == 1
    done = clod("eval dial.ply --images SCENE --sv 3 1 --json")
    assert " 333.3 ±83.3" in done.err + done.out
    rows = done.report["rows"]
    assert [(row["virtual_scale"], round(row["frame_ms"])) for row in rows] == [(3, 333), (1, 1000)]


def test_eval_at_a_budget(clod, attenuated):
    """Within the range, at s = 1 if that is enough; a psnr drop out of reach gives the range's end;
    with notes.
    """
    rows = load(attenuated).quality_table.rows
    middle = round(rows[0].kept * 0.4 + rows[-1].kept * 0.6)
    report = clod(EVAL, "--keep", middle, 300).report
    solved, whole = report["rows"]
    s = solved["virtual_scale"]
    assert solved["kept"] == middle and 1 < s < 4 and whole["virtual_scale"] == 1
    assert report["notes"] == [
        f"--keep {middle}: s = {s:.5g}",
        f"--keep 300: s = 1 (s = 1 keeps {rows[0].kept:,.0f} of 300 already)",
    ]
    drop = rows[0].psnr - rows[2].psnr
    report = clod(EVAL, "--psnr-drop", drop, 90).report
    solved, last = report["rows"]
    assert solved["virtual_scale"] == pytest.approx(rows[2].virtual_scale)
    assert rows[0].psnr - solved["psnr"] == pytest.approx(drop, abs=0.02)
    assert last["virtual_scale"] == 4
    assert "largest dial value measured" in report["notes"][1]
    report = clod(EVAL, "--fps 1").report
    timed, *_, solved = report["notes"]
    assert report["rows"][0]["virtual_scale"] == 1
    assert re.match(r"frames timed here: \S+ ms at s = 1, \S+ ms at s = 4", timed)
    assert re.match(r"--fps 1: s = 1 \(s = 1 draws \d+ frames a second already\)", solved)


def test_baking_to_a_budget(clod, attenuated):
    model = load(attenuated)
    table = model.quality_table
    rows = tuple(replace(row, frame_ms=8 / row.virtual_scale) for row in table.rows)
    elsewhere = replace(table, rows=rows, machine="another", width=640, height=480)
    save("there.ply", model.gaussians, model, quality_table=elsewhere)
    report = clod("export there.ply --fps 250 -o f.ply --json").report
    assert report["outputs"][0]["virtual_scale"] == pytest.approx(2)
    assert report["notes"] == ["--fps 250: s = 2 (frame times of another at 640x480)"]
    done = clod("export there.ply --fps 1000000 -o g.ply", code=2)
    assert done.err.endswith("500 a second (frame times of another at 640x480)\n")
    report = clod("export DIAL --json -o p.ply --psnr-drop", rows[0].psnr - rows[2].psnr).report
    (output,) = report["outputs"]
    assert output["virtual_scale"] == pytest.approx(rows[2].virtual_scale)


def test_device_presets_are_counts(clod, capture, attenuated, monkeypatch):
    """For export the count of the file, for view and a page the dial value that they open at."""
    assert [*DEVICES] == ["quest3", "phone", "laptop", "desktop"]
    assert sorted(DEVICES.values()) == [*DEVICES.values()]
    monkeypatch.setitem(DEVICES, "quest3", 120)
    done = clod("export DIAL --device-preset quest3 -o few.ply --json")
    assert 115 <= done.report["outputs"][0]["count"] == len(load("few.ply").gaussians) <= 120
    assert done.note("preset").startswith("--device-preset quest3, --keep 120: s = ")
    words = [str(attenuated), "--images", str(capture.scene), "--device-preset", "quest3"]
    answers, report = view.make_page(build_parser("view").parse_args(words), view.Console(True))
    page = b"".join(answers["/"].blocks()).decode()
    opening = float(re.findall(r'"virtual_scale": ([\d.]+)[,}]', page)[-1])
    model = load(attenuated).gaussians
    scene = load_scene(capture.scene)
    views = scene.train + scene.test
    kept = fmean(int(render(model, view.camera, opening).kept.sum()) for view in views)
    assert kept == pytest.approx(120, abs=3)
    assert "quest3" in str(report["notes"])


RENDER = "render DIAL --images SCENE --json -o"


def test_an_image_per_view(clod, capture, attenuated, tmp_path):
    """Of the held-out views, of all, or of one, for which a count is solved."""
    done = clod(RENDER, "out/here --sv 1 3 --beside")
    assert done.report["virtual_scales"] == [1, 3] and not done.report["interrupted"]
    pictures = done.report["pictures"]
    shown = [Path(picture["file"]).name for picture in pictures]
    assert names(tmp_path / "out" / "here") == shown == ["000.png", "008.png"]
    scene = load_scene(capture.scene)
    gaussians = load(attenuated).gaussians
    for held_out, picture in zip(scene.test, pictures, strict=True):
        pixels = np.asarray(Image.open(picture["file"]))
        assert pixels.shape == (48, 3 * 64, 3)
        photograph, *renders = np.split(pixels, 3, axis=1)
        assert (photograph == held_out.image.numpy()).all()
        for s, pixels, kept in zip((1.0, 3.0), renders, picture["kept"], strict=True):
            want = render(gaussians, held_out.camera, s)
            assert np.abs(pixels - 255 * want.image.clamp(0, 1).numpy()).max() <= 0.51
            assert kept == want.kept.sum()
    assert re.search(r"s = 3: [\d.]+ of 300 Gaussians, \d+\.\d\d dB", done.err)
    n = pictures[0]["kept"][1]
    (picture,) = clod(RENDER, "one --views 000 --keep", n).report["pictures"]
    assert picture["view"] == "000.png" and picture["kept"] == [n]
    report = clod(RENDER, "all --views all").report
    assert [p["view"] for p in report["pictures"]] == names(tmp_path / "all")
    assert report["virtual_scales"] == [1] and len(report["pictures"]) == 10


@pytest.mark.parametrize("presses", [1, 2])
def test_interrupts(clod, tmp_path, monkeypatch, presses):
    """After one the image under way is finished; two abort."""
    write = pressing(command.write_png, *[signal.SIGINT] * presses)
    monkeypatch.setattr(command, "write_png", write)
    done = clod(RENDER, "out", code=0 if presses == 1 else 130)
    assert [path.name for path in tmp_path.glob("out/*")] == ["000.png"][: 2 - presses], done
    assert presses == 2 or done.report["interrupted"] is True


def test_image_names(capture):
    """In UTF-8; names that are equal without their suffixes keep them."""
    view = load_scene(capture.scene).test[0]
    for photographs, files in (
        (("ä.jpg", "b/ä.jpg", "c\\ä.JPG"), ["ä.png", "b/ä.png", "c/ä.png"]),
        (("a.jpg", "a.png"), ["a.jpg.png", "a.png.png"]),
    ):
        views = [replace(view, camera=replace(view.camera, name=name)) for name in photographs]
        assert [os.fsencode(path).decode() for path in command.image_names(views)] == files
