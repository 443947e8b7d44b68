"""``clod-adapt robustness``: outputs, resuming, interrupts; ``clod-adapt demo``, on the tests' own
capture.
"""

import csv
import json
import re
import shutil
import signal
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import clod_adapter
from clod_adapter import AdaptConfig, adapt_checkpoint, config, evaluate, load, load_scene, pipeline
from clod_adapter import demo as gallery
from clod_adapter.cli.adapt import listeners
from clod_adapter.cli.adapt import run as adapt_run
from clod_adapter.evaluation import robustness as experiment
from clod_adapter.progress import Phase
from clod_adapter.report.page import Picture
from clod_adapter.training import pseudo_views
from runs import names, pressed, results

pytest.importorskip("matplotlib")
OUTPUTS = ["robustness.csv", "robustness.json", "robustness.png"]


@pytest.fixture
def run(clod, capture, tmp_path):
    """Runs the command on two checkpoints, the second without the faintest Gaussians."""
    shutil.copytree(capture.scene, tmp_path / "scene")
    capture.write(tmp_path / "plain.ply", capture.gaussians)
    capture.write(
        tmp_path / "masked.ply", capture.gaussians.select(capture.gaussians.opacities > 0.5)
    )
    return partial(clod, "robustness plain.ply masked.ply --images scene --max-sv 3 1 --iters 3")


def test_the_command_a_cell_and_python_train_the_same(clod, capture, monkeypatch):
    """Bit for bit, on few photographs."""
    monkeypatch.setattr(pseudo_views, "MANY", 64)
    clod("BASE --images SCENE --iters 3 --max-sv 3 --out dial.ply")
    clod("robustness BASE --images SCENE --iters 3 --max-sv 3 --out out")
    base = load(capture.ply)
    scene = load_scene(capture.scene)
    result = adapt_checkpoint(base, scene, AdaptConfig(iters=3, max_sv=3.0))
    for written in ("dial.safetensors", "out/cells/base_sv3.safetensors"):
        assert clod_adapter.load_adapter(written).apply(base.gaussians) == result.gaussians
    result.save("python.ply")
    assert results(Path(), "python") == results(Path())
    assert load("python.ply").quality_table.rows[0].psnr == result.rows[0].psnr


@pytest.mark.usefixtures("few_placed")
def test_the_command_and_python_train_the_same_without_photographs(clod, capture):
    clod("BASE --iters 3 --out dial.ply --accept-loss")
    settings = AdaptConfig.placed(iters=3)
    adapt_checkpoint(load(capture.ply), config=settings).save("python.ply")
    assert results(Path(), "python") == results(Path())


@pytest.mark.parametrize("phase", [Phase.EVALUATION, Phase.FRAME_TIMES])
def test_a_stop_after_training_keeps_the_result(capture, tmp_path, phase):
    trained = []

    def progress(done):
        trained.append(done.phase is Phase.TRAINING)
        return not (any(trained) and done.phase is phase)

    scene = load_scene(capture.scene)
    settings = AdaptConfig(iters=3)
    result = adapt_checkpoint(load(capture.ply), scene, settings, progress=progress)
    assert result.adapted.steps == 3 and not result.rows and result.base_rows
    assert any("not measured" in note for note in result.notes)
    result.save(tmp_path / "stopped.ply")
    assert load(tmp_path / "stopped.ply").gaussians == result.gaussians


def stamps(folder):
    return {path.name: path.stat().st_mtime_ns for path in (folder / "cells").iterdir()}


def test_outputs_of_all_cells(run, clod, monkeypatch):
    monkeypatch.setattr("clod_adapter.cli.shared.console.LINE_EVERY", 0)
    done = run("--json")
    report = done.report
    folder = Path("robustness")
    assert names(folder) == ["cells", *OUTPUTS]
    assert report == json.loads((folder / "robustness.json").read_text())
    assert report["missing"] == [] and not report["interrupted"]
    cells = {(cell["checkpoint"], cell["max_sv"]): cell["rows"] for cell in report["cells"]}
    assert list(cells) == [*product(("plain", "masked"), (None, 1, 3))]
    shares = experiment.BASELINE_SHARES
    for (_, max_sv), rows in cells.items():
        dials = [1, 1.5, 2, 3] if max_sv else [1.0] * len(shares)
        assert [row["virtual_scale"] for row in rows] == dials
    with open(folder / "robustness.csv", newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 2 * (len(shares) + 8)
    for max_sv, within in ((1, "TFFF"), (3, "TTTT"), (None, " " * len(shares))):
        name = f"{max_sv:.1f}" if max_sv else "base"
        rows = [row for row in table if (row["checkpoint"], row["max_sv"]) == ("masked", name)]
        assert "".join(row["within_range"][:1] or " " for row in rows) == within
        wanted = [row["psnr"] for row in cells["masked", max_sv]]
        assert [float(row["psnr"]) for row in rows] == wanted
    assert Image.open(folder / "robustness.png").size[0] > 2000
    scene = load_scene(report["scene"])
    base = load("plain.ply").gaussians
    pruned = cells["plain", None]
    assert [row["kept"] for row in pruned] == [round(300 * share) for share in shares]
    few = base[base.opacities.argsort(descending=True)[: round(300 * shares[-1])]]
    (row,) = evaluate(few, scene.test, [1.0])
    assert row.psnr == pytest.approx(pruned[-1]["psnr"])
    clod("apply plain.ply robustness/cells/plain_sv3.safetensors -o x.ply")
    (row,) = evaluate(load("x.ply").gaussians, scene.test, [3.0])
    assert row.psnr == cells["plain", 3][-1]["psnr"]
    lines = re.findall(r"^(\w+) \((\d)/6\) training +\d+%, .* left", done.err, re.M)
    assert lines[0] == ("plain_sv1", "2") and len(set(lines)) == 4


@pytest.mark.usefixtures("blank_figure")
def test_interrupted_unfinished_and_changed_cells(run):
    """Finished cells stay; unfinished and changed ones run again. An interrupt of the first one
    writes nothing.
    """
    folder = Path("robustness")
    with pressed(experiment, "baseline", signal.SIGINT):
        run(code=130)
    assert not folder.exists()
    with pressed(experiment, "adapt_at_range", signal.SIGINT, at=2):
        done = run("--json")
    report = done.report
    assert report["interrupted"] and "plain_sv3 was not finished" in done.err
    assert [cell["max_sv"] for cell in report["cells"]] == [None, 1]
    assert report["missing"] == ["plain_sv3", "masked_base", "masked_sv1", "masked_sv3"]
    assert all((folder / name).exists() for name in OUTPUTS)
    done = run("--json --quiet")
    assert done.report["missing"] == [] and done.report["cells"][:2] == report["cells"]
    assert done.err == ""
    before = stamps(folder)
    assert len(before) == 10
    (folder / "cells" / "masked_sv1.safetensors").unlink()
    assert "5 of 6 cells are done already" in run().err
    changed = {name for name, stamp in stamps(folder).items() if stamp != before.get(name)}
    assert changed == {"masked_sv1.safetensors", "masked_sv1.json"}
    shutil.copy("plain.ply", "masked.ply")
    # baselines do not depend on the seed
    assert "1 of 6 cells are done already: plain_base" in run("--seed 1").err
    # of a photograph that is trained on
    Image.new("RGB", (64, 48)).save("scene/images/003.png")
    with pressed(experiment, "baseline", signal.SIGINT):
        run("--seed 1", code=130)


PICTURES = {"dial.png", "curve.png"}


def test_demo(clod, capture, tmp_path, monkeypatch):
    """It names its files and the next command, resumes without naming --resume, and reports no
    figure not drawn.
    """

    def unpack(scene, base):
        shutil.copytree(capture.scene, scene, dirs_exist_ok=True)
        shutil.copyfile(capture.ply, base)

    # the tests' own capture, a few steps, and empty pictures
    monkeypatch.setattr(gallery, "unpack", unpack)
    monkeypatch.setattr(
        gallery, "draw", lambda *given: [path.write_bytes(b"") for path in given[-1].values()]
    )
    monkeypatch.setattr(config, "STEPS", 2)
    monkeypatch.setattr(config, "STEPS_PER_VIEW", 0)
    monkeypatch.setattr(adapt_run, "LOST", (99.0, 99.0))  # two steps cannot keep full quality
    folder = tmp_path / "-odd"
    state = Path("-odd/gallery.resume.safetensors")
    with pressed(listeners, "save_state", signal.SIGINT, signal.SIGTERM, at=2):
        clod("demo --out=-odd", code=130)
    with monkeypatch.context() as patch:
        patch.setattr(listeners, "package_version", lambda: "0.0.7")
        done = clod("demo --out=-odd", code=2)
    assert f"{state}: is of " in done.err and "delete it to start over" in done.err
    assert "--resume" not in done.err and state.exists()
    assert clod("demo --out=-odd --json").report["resumed_from"] == 1 and not state.exists()
    done = clod("demo --out=-odd")
    assert f"everything is in {folder}" in done.out and "clod-adapt YOURS.ply" in done.out
    found = clod("demo --out=-odd --quiet --json").report
    assert found["command"] == "demo"
    assert found["folder"] == "-odd"
    assert found["scene"] == "-odd/capture"
    assert found["pictures"] == {"dial": "-odd/dial.png", "curve": "-odd/curve.png"}
    assert found["config"]["max_sv"] == 5
    made = {"capture", "base.ply", "gallery.ply", "gallery.safetensors", "gallery.json"}
    assert {*names(folder)} == made | PICTURES
    # nothing is measured
    with pressed(pipeline, "extract_adapter", signal.SIGINT):
        done = clod("demo --out=-odd --json")
    assert done.report["pictures"] == {} and "no figures" in done.err
    assert not PICTURES & {*names(folder)}


def test_scene_and_base_of_the_package(tmp_path):
    """The base is trained to its end, and packing it and the photographs cost little."""
    files = [Path(gallery.__file__).with_name(name) for name in ("base.spz", "capture.zip")]
    assert files[0].stat().st_size < 2e6 and sum(path.stat().st_size for path in files) < 3e6
    capture = tmp_path / "capture"
    base = tmp_path / "base.ply"
    for _ in range(2):  # what exists is left
        gallery.unpack(capture, base)
    scene = load_scene(capture)
    checkpoint = load(base)
    assert (len(scene.train), len(scene.test), checkpoint.notes, scene.notes) == (70, 10, (), ())
    assert evaluate(checkpoint.gaussians, scene.test[:2], [0])[0].psnr > 30


def test_strip_shows_every_panel(tmp_path):
    colours = [(200, 30, 30), (30, 160, 30), (30, 30, 200)]
    images = [np.full((30, 40, 3), colour, np.uint8) for colour in colours]
    panels = [Picture(image, "s = 1", "29.0 dB") for image in images]
    gallery.dial_strip(tmp_path / "strip.png", panels, "one view", crop=(10, 5, 16, 12))
    picture = np.asarray(Image.open(tmp_path / "strip.png").convert("RGB"))
    for k, colour in enumerate(colours):
        third = picture[:, k * picture.shape[1] // 3 : (k + 1) * picture.shape[1] // 3]
        assert (np.abs(third.astype(int) - colour).max(2) <= 1).mean() > 0.6
    assert (picture[0] == 255).all() and picture.shape[0] > 2 * 12 / 16 * picture.shape[1] / 3
