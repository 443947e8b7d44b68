"""``clod-adapt PLY --images DIR``: files, report and what is printed; its plan, stored, overridden,
applied.
"""

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image

from clod_adapter import detach, evaluate, load, load_adapter, load_scene
from clod_adapter._support.machine import machine_name
from clod_adapter.cli import adapt
from clod_adapter.config import AdaptConfig
from clod_adapter.training.plan import NAMES
from models import write_model
from runs import OUTPUTS, names, rebuilt, results

TINY = "--iters 12 --max-sv 4 --out dial.ply"


def columns(path):
    return list(load(path).vertex.dtype.names)


@pytest.fixture(scope="module")
def adapted(run_in, tmp_path_factory):
    """A run that loses more than is accepted, with a line of progress per step."""
    folder = tmp_path_factory.mktemp("adapted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("clod_adapter.cli.shared.console.LINE_EVERY", 0)
        done = run_in(folder, "BASE --images SCENE", TINY, code=1, accept=False)
    return folder, done


def test_writes_three_files(adapted, capture, attenuated):
    """The same seed gives the same bits. The report agrees with them at both ends of the dial and
    without it.
    """
    folder, done = adapted
    assert names(folder) == OUTPUTS, done
    assert len({path.stat().st_mode for path in folder.iterdir()}) == 1, done
    report = json.loads((folder / "dial.json").read_text())
    data = (folder / "dial.ply").read_bytes()
    want = {
        "command": "adapt",
        "model": str(capture.ply),
        "scene": str(capture.scene),
        "base_count": 300,
        "sh_degree": 1,
        "steps": 12,
        "interrupted": False,
        "notes": [],
        "screen_filter": {"variance": 0.3, "compensate": False},
        "outputs": {"ply": "dial.ply", "adapter": "dial.safetensors", "report": "dial.json"},
        "adapter_bytes": (folder / "dial.safetensors").stat().st_size,
        "ply_bytes": len(data),
    }
    assert report.items() >= want.items()
    assert (report["alignment"]["guess"], report["alignment"]["explained"]) == (None, 1)
    assert set(report["config"]) == set(AdaptConfig.__dataclass_fields__)
    assert report["config"]["max_sv"] == 4
    assert set(report["machine"]) >= {"cpu", "cores", "python", "torch", "numba"}
    steps = {"load", "kernels", "plan", "start", "train", "evaluate", "total"}
    assert set(report["seconds"]) == steps
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 1.5, 2, 3, 4]
    shares = [row["kept_share"] for row in report["rows"]]
    assert shares == sorted(shares, reverse=True) and 0 < shares[-1] < 0.5
    assert columns(folder / "dial.ply")[-3:] == ["sigma_d", "growth_d", "opacity_d"]
    assert b"screen_filter" not in data
    assert results(folder) == results(attenuated.parent)
    model = load(folder / "dial.ply")
    views = load_scene(capture.scene).test
    measured = evaluate(detach(model.gaussians), views, [1.0])
    measured += evaluate(model.gaussians, views, [1.0, 4.0])
    reported = (report["detached_row"], *report["rows"][::4])
    for entry, row in zip(reported, measured, strict=True):
        assert entry.pop("frame_ms_range") > 0
        assert {**entry, "frame_ms": 0} == {**row.as_dict(), "frame_ms": 0}
    stored = model.quality_table
    assert stored == load_adapter(folder / "dial.safetensors").quality_table
    assert stored.as_dict() == report["calibration"] and stored.machine == machine_name()
    for row, measured in zip(stored.rows, report["rows"], strict=True):
        assert vars(row).items() <= measured.items()
    assert (stored.total, stored.views, stored.width, stored.height) == (540, 2, 64, 48)


def test_prints_progress_a_table_next_commands_and_a_loss(adapted, capture):
    folder, done = adapted
    table = done.out.splitlines()[1:9]
    first = [line.split()[0] for line in table]
    assert first == ["dial", "base", "1", "1.5", "2", "3", "4", "plain"]
    assert len(set(map(len, table))) == 1  # aligned
    view, measure = done.out.replace("\\\n", "").split("next:\n")[1].splitlines()
    scene = f"--images {shlex.quote(str(capture.scene))}"
    base = shlex.quote(str(capture.ply))
    wanted = f"clod-adapt view dial.ply --base {base} {scene}"
    assert shlex.split(view) == shlex.split(wanted)
    assert shlex.split(measure) == shlex.split(f"clod-adapt eval dial.ply {scene} --sv 1 4")
    assert "Gaussians: 300, SH degree 1" in done.err
    assert "8 photographs to train on, 2 held out, 64x48" in done.err
    assert "trained 12 steps" in done.err and "\r" not in done.err
    for line in (
        r"training   8%, \d.* left, 1/12",
        r"importance  50%, \d.* left, \d+/\d+",
        r"base: [\d.]+ dB on .*",
    ):
        assert re.search(f"^{line}$", done.err, re.M)
    report = json.loads((folder / "dial.json").read_text())
    # more than is accepted: the exit code is 1
    lost = report["base_rows"][0]["psnr"] - report["rows"][0]["psnr"]
    assert f"s = 1 is {lost:.2f} dB below the base" in report["loss"]
    assert "train longer (--iters)" in report["loss"]
    assert done.err.endswith(f"\nwarning: {report['loss']}\n")


def test_forecast_of_time_and_memory(clod):
    """In a line before training, and with what the run took in the report."""
    done = clod("BASE --images SCENE --max-sv 2 --out dial.ply --json --iters 100")
    found = done.report["forecast"]
    assert re.search(r"^forecast: \S+ s, \d.* [MG]B \(100 steps\)$", done.err, re.M)
    assert done.err.index("\nforecast: ") < done.err.index("\ntrained 100 steps")
    assert found["steps"] == 100 and found["seconds"] > 0 and found["actual_seconds"] > 0
    assert found["bytes"] == pytest.approx(found["actual_bytes"], rel=1 / 3)


def test_dial_of_the_checkpoint_is_continued(clod, attenuated):
    """Its growth is dropped with --growth off, which a note says; a dial without growth starts with
    exponents of 0.
    """
    line = "--images SCENE --device cpu --max-sv 4 --out dial.ply --json --quiet --iters 0"
    dropped = "sigma_d; its growth_d is dropped, as growth is off"
    for model, more, note, stored in (
        (attenuated, "", "sigma_d and growth_d", ["sigma_d", "growth_d", "opacity_d"]),
        (attenuated, "--growth off", dropped, ["sigma_d", "opacity_d"]),
        ("off.ply", "", "sigma_d", ["sigma_d", "growth_d", "opacity_d"]),
    ):
        done = clod(model, line, more)
        noted = f"{model} has a dial already: continuing from its {note}"
        assert done.err == "" and noted in done.report["notes"] and done.report["device"] == "cpu"
        assert columns("dial.ply")[-len(stored) :] == stored and rebuilt(clod, model)
        if more:
            assert load_adapter("dial.safetensors").growth_d is None
            shutil.copy("dial.ply", "off.ply")
    growth_d = load("dial.ply").gaussians.growth_d
    assert growth_d is not None and not growth_d.any()


def test_without_held_out_photographs(clod, capture, tmp_path):
    view = load_scene(capture.scene).train[0]
    (tmp_path / "one" / "images").mkdir(parents=True)
    write_model(tmp_path / "one", [view.camera], ["a.png"])
    Image.fromarray(view.image.numpy()).save(tmp_path / "one" / "images" / "a.png")
    done = clod("BASE --images one --iters 0 --max-sv 4 --out dial.ply --json")
    assert done.report["rows"] == done.report["base_rows"] == [] and "no photographs" in done.err
    clod("eval dial.ply --images one", code=2)


@pytest.mark.usefixtures("few_placed")
def test_without_photographs(clod, tmp_path, monkeypatch):
    """The target images are renders of the base, rounded to bytes."""
    # dB, more than the result has
    monkeypatch.setattr("clod_adapter.cli.adapt.run.ENOUGH", (50.0, 25.0))
    done = clod("BASE", TINY, "--json")
    report = done.report
    assert report["scene"] is None
    assert report["supervision"] == "checkpoint"
    assert report["seconds"]["place"] > 0
    (note,) = report["notes"]
    assert note in done.err
    assert "no photographs: 14 pseudo views to train on, 2 held out, 62x46, " in note
    assert "held-out photographs" not in done.err
    assert "--images" not in done.err.split("next:\n")[1].split("warning")[0]
    full = report["rows"][0]["psnr"]
    assert report["base_rows"][0]["psnr"] > 50 > full > report["rows"][-1]["psnr"]
    assert len(report["rows"]) == 5
    assert f"s = 1 has {full:.2f} dB against" in report["loss"] and names(tmp_path) == OUTPUTS
    assert rebuilt(clod, "BASE") and report["calibration"]["against"] == "checkpoint"
    (note, *_) = clod("export dial.ply --psnr-drop 1 -o plain.ply --json").report["notes"]
    assert "without photographs, against renders of the checkpoint" in note


def test_ci_banana(clod, ci_banana):
    """A real capture."""
    base = ci_banana / "pretrained.ply"
    words = (base, "--images", ci_banana / "images", "--iters 5 --max-sv 3 --out dial.ply --json")
    report = clod(*words).report
    assert report["base_count"] == 20_000
    assert report["base_rows"][0]["psnr"] == pytest.approx(25.81, abs=0.02)
    assert report["rows"][-1]["kept_share"] < 0.3


def test_unusual_inputs(clod, capture):
    """Few photographs get pseudo views; invisible Gaussians cannot do without any."""
    shutil.copytree(capture.scene, "few")
    for k in range(1, 5):
        Path(f"few/images/{k:03}.png").unlink()
    done = clod("BASE --images few --iters 2 --out dial.ply --json")
    assert "8 pseudo views" in done.note("photographs to train on")
    assert done.note("4 of 10 photographs are missing and left out (001.png, ")
    logits = torch.full_like(capture.gaussians.opacity_logits, -20.6)
    capture.write("none.ply", capture.gaussians.replace(opacity_logits=logits))
    done = clod("none.ply --out dial.ply --quiet", code=2)
    assert done.err.count("\n") == 1 and "no camera can be placed" in done.err


SHORT = "--images SCENE --iters 24 --max-sv 4 --out dial.ply --json"


@pytest.fixture
def wasteful(capture, tmp_path):
    """The capture's checkpoint with a degree that does nothing, and 50 Gaussians that no camera
    sees among the rest.
    """
    base = capture.gaussians
    far = base.select(torch.arange(50)).replace(
        means=base.means[:50] + torch.tensor([0.0, 90.0, 0.0])
    )
    values = {
        name: torch.cat([far.tensors()[name], value]) for name, value in base.tensors().items()
    }
    values["shN"] = torch.cat([values["shN"], 1e-5 * torch.ones(350, 5, 3)], 1)
    return Path(capture.write(tmp_path / "wasteful.ply", base.replace(**values)))


def decisions(done):
    return {decision["what"]: decision for decision in done.report["plan"]["decisions"]}


def test_the_plan_is_printed_and_stored(clod, wasteful):
    """What is left out of the training is in the file unchanged."""
    done = clod(wasteful, SHORT)
    lines = re.findall(r"^plan: .*?^trained 24 steps", done.err, re.M | re.S)[0].splitlines()
    assert max(map(len, lines)) <= 80
    table = {line[2:].split("  ")[0]: line for line in lines if line.startswith("  ")}
    assert re.search(r"left out +0\.0\d\d dB +--with bands$", table["SH degree 2"])
    assert re.search(r"kept +\d+\.\d+ dB +--without bands$", table["SH degree 1 to 2"])
    assert table.pop("does not apply: undistortion, scaling")  # one line for both
    assert not {"exposure", "alpha", "masks"} & set(table), done  # of which the scene has none
    # listed only if frozen
    assert not {"means", "quats", "scales", "opacities", "sh0"} & set(table), done
    stored = decisions(done)
    seconds = done.report["plan"]["seconds"]
    assert list(stored) == [*table, "undistortion", "scaling"]
    assert stored["far Gaussians"]["number"] == 280
    assert set(seconds) == {"bands", "start"} and done.report["seconds"]["plan"] > 0
    base, whole = (load(path).gaussians for path in (wasteful, "dial.ply"))
    assert (whole.whole, len(whole)) == (350, 630) and detach(whole) == base
    assert rebuilt(clod, wasteful)


def test_overrides(clod, wasteful):
    """Whose names are the options' too."""
    assert adapt.NAMES == NAMES
    done = clod(wasteful, SHORT, "--with bands --without quats --with sh0 --without means")
    stored = decisions(done)
    assert stored["SH degrees"]["verdict"] == "kept"
    others = {name: d["verdict"] for name, d in stored.items() if d["name"] not in ("bands", "")}
    assert others == {"means": "frozen", "quats": "frozen"}
    assert re.search(r"^  quats +frozen +- +--with quats$", done.err, re.M)
    adapter = load_adapter("dial.safetensors")
    assert not adapter.updates and len(adapter.added["means"]) == 280
