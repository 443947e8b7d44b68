"""``clod-adapt eval``: rows, comparisons, popping, budgets, as of export; ``render``: images,
views, interrupts.
"""

import re
import signal
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import clod_adapter
from clod_adapter import load_scene, render
from clod_adapter.cli import render as command
from clod_adapter.cli import view
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared.command import DEVICES
from clod_adapter.evaluation import calibrate, frame_times
from clod_adapter.evaluation import evaluate as module
from clod_adapter.evaluation.frame_times import FrameTimes, Model
from clod_adapter.io.checkpoint import load, save
from runs import pressing

EVAL = "eval DIAL --images SCENE --json"
ROW = {"virtual_scale", "psnr", "ssim", "kept", "kept_share", "in_view", "frame_ms"}


def test_rows_and_default_dial_values(clod: Any, capture: Any, dialled: Path) -> None:
    """The defaults are within the trained range; a plain file has one picture and no popping."""
    done = clod(EVAL)
    report = done.report
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2, 3, 4]
    assert report["notes"] == []
    assert (report["model"], report["scene"], report["base_count"]) == (
        str(dialled),
        str(capture.scene),
        300,
    )
    for row in report["rows"]:
        assert set(row) == ROW and row["in_view"] <= row["kept"]
        assert row["kept_share"] == row["kept"] / 300 and row["frame_ms"] > 0
        assert 0 < row["psnr"] < 100 and 0 < row["ssim"] <= 1
    assert "PSNR dB" in done.err and done.out.count("\n") == 1
    (note,) = (done := clod(EVAL, "--sv 8")).report["notes"]
    assert note.startswith("trained up to s = 4;") and note in done.err
    report = (done := clod("eval BASE --images SCENE --popping --json")).report
    assert report["popping"] == []
    assert any("popping is not measured" in note for note in report["notes"])
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2, 3, 5]
    assert {row["kept_share"] for row in report["rows"]} == {1.0}
    assert len({row["psnr"] for row in report["rows"]}) == 1
    assert report["attenuation"] is None and "has no sigma_d" in done.err
    done = clod("eval BASE --images SCENE --quiet")
    assert len(done.out.splitlines()) == 5 and done.err == ""


def test_base_by_rank_and_popping(clod: Any, capture: Any) -> None:
    report = (done := clod(EVAL, "--sv 1 4 --base BASE --popping")).report
    assert report["base"] == str(capture.ply)
    assert report["base_row"]["kept"] == 300
    assert report["interrupted"] is False
    kept = {row["virtual_scale"]: round(row["kept"]) for row in report["rows"]}
    assert [
        (entry["virtual_scale"], entry["by"], entry["row"]["kept"]) for entry in report["ranked"]
    ] == [(s, by, kept[s]) for s in (1, 4) for by in ("opacity", "removal error")]
    assert all(
        entry["row"]["kept_share"] == entry["row"]["kept"] / 300 for entry in report["ranked"]
    )
    base = capture.gaussians
    views = load_scene(capture.scene).test
    top = base.opacity_logits.argsort(descending=True)[: kept[4]]
    (want,) = clod_adapter.evaluate(base.select(top), views, [1.0])
    by_opacity, by_error = (entry["row"]["psnr"] for entry in report["ranked"][2:])
    assert by_opacity == pytest.approx(want.psnr, abs=1e-4) and by_error > by_opacity
    block = done.err[done.err.index("pruned to the same counts") :].splitlines()[2:]
    by = ["opacity", "removal"]  # and error
    assert [line.split()[0] for line in block[:7]] == ["base", "s=1", *by, "s=4", *by]
    assert report["against"] == []
    moved = ["dial, 000.png", "dial, 008.png", "camera, 002.png to 006.png, s = 4"]
    assert [entry["moved"] for entry in report["popping"]] == moved
    assert f"\n{moved[2]}\n" in done.err
    assert all(
        entry["steps"] == len(entry["changes"]) == 200 and entry["ratio"] > 1
        for entry in report["popping"]
    )
    assert re.search(r"^ +steps +mean", done.err, re.M)


def test_against_at_matched_counts(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """Files of one name have their folders as labels."""
    # within the dial's reach
    count = sum(row.kept for row in load(dialled).calibration.rows[::4]) // 2
    for name, size in (("a", int(count)), ("b", 300)):
        (tmp_path / name).mkdir()
        capture.write(tmp_path / name / "cloud.ply", capture.gaussians.select(torch.arange(size)))
    report = (done := clod(EVAL, "--sv 1 2 --against a/cloud.ply b/cloud.ply DIAL")).report
    assert [entry["label"] for entry in report["against"]] == ["a_cloud", "b_cloud", "dial", "dial"]
    pairs = [(entry["theirs"]["kept"], entry["ours"]["kept"]) for entry in report["against"]]
    assert pairs[0][0] == count == pytest.approx(pairs[0][1], abs=1)
    assert pairs[1][0] == 300 > pairs[1][1] == report["rows"][0]["kept"]
    (note,) = [note for note in report["notes"] if "keeps 300 Gaussians" in note]
    assert note in done.err
    assert "at most" in note
    assert "the dial value with the same count" in done.err
    for own, row in zip(report["against"][2:], report["rows"], strict=True):  # compared with itself
        assert own["theirs"]["psnr"] == row["psnr"]
        assert own["ours"]["kept"] == pytest.approx(row["kept"], rel=2e-3)


def test_interrupt_keeps_finished_comparisons(clod: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "evaluate", pressing(module.evaluate, signal.SIGINT, at=3))
    report = clod(EVAL, "--sv 1 2 --base BASE --popping").report
    assert report["interrupted"] is True and len(report["rows"]) == 2 and report["popping"] == []
    assert report["base_row"] and [entry["by"] for entry in report["ranked"]] == ["opacity"]


def test_frames_are_timed_together(clod: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of base, result and plain file; frames take 1000/s ms, and those of the k-th model k
    times that.
    """
    seen = []

    def times(models: Sequence[Model], cameras: Any, progress: Any) -> FrameTimes:
        seen.append([len(some) for some, _ in models])
        found = tuple(
            tuple(1000.0 * (k + 1) / s for s in dials) for k, (_, dials) in enumerate(models)
        )
        return FrameTimes(found, 0.5)

    monkeypatch.setattr(calibrate, "time_frames", times)
    monkeypatch.setattr(frame_times, "NOISY", 0.2)
    report = (done := clod("BASE --images SCENE --iters 2 --max-sv 4 --out dial.ply --json")).report
    assert seen == [[300, 540, 300]]
    assert [
        row.frame_ms * row.virtual_scale for row in load("dial.ply").calibration.rows
    ] == pytest.approx([2000] * 5)
    assert (report["base_rows"][0]["frame_ms"], report["detached_row"]["frame_ms"]) == (1000, 3000)
    assert any("frame times are rough: they varied by 50%" in note for note in report["notes"])
    assert done.err.count("frame times are rough") == 1
    rows = clod("eval dial.ply --images SCENE --sv 3 1 --json").report["rows"]
    assert [(row["virtual_scale"], round(row["frame_ms"])) for row in rows] == [(3, 333), (1, 1000)]


def test_eval_at_a_budget(clod: Any, dialled: Path) -> None:
    """Within the range, at s = 1 if that is enough; a psnr drop out of reach gives the range's end;
    with notes.
    """
    rows = load(dialled).calibration.rows
    middle = round(rows[0].kept * 0.4 + rows[-1].kept * 0.6)
    drop = rows[0].psnr - rows[2].psnr
    report = clod(EVAL, "--keep", middle, 300).report
    found, whole = report["rows"]
    s = found["virtual_scale"]
    assert found["kept"] == middle and 1 < s < 4 and whole["virtual_scale"] == 1
    assert report["notes"] == [
        f"--keep {middle}: s = {s:.5g}",
        f"--keep 300: s = 1 (s = 1 keeps {rows[0].kept:,.0f} of 300 already)",
    ]
    report = clod(EVAL, "--psnr-drop", drop, 90).report
    found, last = report["rows"]
    assert found["virtual_scale"] == pytest.approx(rows[2].virtual_scale)
    assert last["virtual_scale"] == 4
    assert rows[0].psnr - found["psnr"] == pytest.approx(drop, abs=0.02)
    assert "largest dial value measured" in report["notes"][1]
    report = clod(EVAL, "--fps 1").report
    timed, *_, solved = report["notes"]
    assert report["rows"][0]["virtual_scale"] == 1
    assert re.match(r"frames timed here: \S+ ms at s = 1, \S+ ms at s = 4", timed)
    assert re.match(r"--fps 1: s = 1 \(s = 1 draws \d+ frames a second already\)", solved)


def test_baking_to_a_budget(clod: Any, dialled: Path) -> None:
    model = load(dialled)
    table = load(dialled).calibration
    rows = tuple(replace(row, frame_ms=8 / row.virtual_scale) for row in table.rows)
    elsewhere = replace(table, rows=rows, machine="another", width=640, height=480)
    save("there.ply", model.gaussians, model, calibration=elsewhere)
    report = clod("export there.ply --fps 250 -o f.ply --json").report
    assert report["outputs"][0]["virtual_scale"] == pytest.approx(2)
    assert report["notes"] == ["--fps 250: s = 2 (frame times of another at 640x480)"]
    done = clod("export there.ply --fps 1000000 -o g.ply", code=2)
    assert done.err.endswith("500 a second (frame times of another at 640x480)\n")
    (output,) = clod("export DIAL --json -o p.ply --psnr-drop", rows[0].psnr - rows[2].psnr).report[
        "outputs"
    ]
    assert output["virtual_scale"] == pytest.approx(rows[2].virtual_scale)


def test_device_presets_are_counts(
    clod: Any, capture: Any, dialled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For export the count of the file, for view and a page the dial value that they open at."""
    assert [*DEVICES] == ["quest3", "phone", "laptop", "desktop"]
    assert sorted(DEVICES.values()) == [*DEVICES.values()]
    monkeypatch.setitem(DEVICES, "quest3", 120)
    report = clod("export DIAL --device-preset quest3 -o few.ply --json").report
    assert 115 <= report["outputs"][0]["count"] == len(load("few.ply").gaussians) <= 120
    (note,) = [note for note in report["notes"] if "preset" in note]
    assert note.startswith("--device-preset quest3, --keep 120: s = ")
    args = build_parser("view").parse_args(
        f"{dialled} --images {capture.scene} --device-preset quest3".split()
    )
    answers, report = view.make_page(args, view.Console(True))
    page = b"".join(answers["/"].blocks()).decode()
    opening = float(re.findall(r'"virtual_scale": ([\d.]+)}', page)[-1])
    model = load(dialled).gaussians
    scene = load_scene(capture.scene)
    kept = [
        int(render(model, each.camera, opening).kept.sum()) for each in scene.train + scene.test
    ]
    assert sum(kept) / len(kept) == pytest.approx(120, abs=3)
    assert any("quest3" in note for note in report["notes"])


RENDER = "render DIAL --images SCENE --json -o"


def test_an_image_per_view(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """Of the held-out views, of all, or of one, for which a count is solved."""
    done = clod(RENDER, "out/here --sv 1 3 --beside")
    assert done.report["virtual_scales"] == [1, 3] and not done.report["interrupted"]
    files = sorted(path.name for path in (tmp_path / "out" / "here").iterdir())
    pictures = done.report["pictures"]
    assert files == ["000.png", "008.png"] == [Path(picture["file"]).name for picture in pictures]
    scene = load_scene(capture.scene)
    gaussians = clod_adapter.load(dialled).gaussians
    for held_out, picture in zip(scene.test, pictures, strict=True):
        pixels = np.asarray(Image.open(picture["file"]))
        assert pixels.shape == (48, 3 * 64, 3) and (pixels[:, :64] == held_out.image.numpy()).all()
        for k, s in enumerate((1.0, 3.0)):
            want = render(gaussians, held_out.camera, s)
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


@pytest.mark.parametrize("presses", [1, 2])
def test_interrupts(
    clod: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, presses: int
) -> None:
    """After one the image under way is finished; two abort."""
    monkeypatch.setattr(
        command, "write_png", pressing(command.write_png, *[signal.SIGINT] * presses)
    )
    done = clod(RENDER, "out", code=0 if presses == 1 else 130)
    assert [path.name for path in tmp_path.glob("out/*")] == ["000.png"][: 2 - presses], done
    assert presses == 2 or done.report["interrupted"] is True


def test_image_names(capture: Any) -> None:
    """Names that are equal without their suffixes keep them."""
    of = load_scene(capture.scene).test[0]
    for names, files in (
        (("ä.jpg", "b/ä.jpg", "c\\ä.JPG"), ["ä.png", "b/ä.png", "c/ä.png"]),
        (("a.jpg", "a.png"), ["a.jpg.png", "a.png.png"]),
    ):
        views = [replace(of, camera=replace(of.camera, name=name)) for name in names]
        assert [str(path) for path in command.image_names(views)] == files
