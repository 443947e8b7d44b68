"""``clod-adapt PLY --images DIR``: files, report, progress, interrupts."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from plyfile import PlyData
from safetensors import safe_open

import clod_adapter
from clod_adapter.cli.adapt import run
from clod_adapter.cli.main import main
from clod_adapter.cli.shared import measure
from clod_adapter.cli.shared.measure import machine_name, report_dials
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap import write_model
from clod_adapter.training import camera_placement
from runs import OUTPUTS, STATE, names, pressing
from scenes import stripped

TINY = ("--iters", 12, "--max-sv", 4, "--out", "dial.ply")
EARLIER = "of an earlier run of clod_adapter"


def columns(path: Path) -> list[str]:
    return list(PlyData.read(str(path))["vertex"].data.dtype.names or ())


def test_writes_three_files(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    before = capture.ply.read_bytes()
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    assert done.code == 0, done
    assert len({path.stat().st_mode for path in tmp_path.iterdir()}) == 1
    assert names(tmp_path) == OUTPUTS and capture.ply.read_bytes() == before
    report = json.loads((tmp_path / "dial.json").read_text())
    assert report["command"] == "adapt" and report["version"]
    assert (report["model"], report["scene"]) == (str(capture.ply), str(capture.scene))
    assert (report["base_count"], report["sh_degree"], report["steps"]) == (300, 1, 12)
    assert report["interrupted"] is False and report["notes"] == []
    assert (report["alignment"]["guess"], report["alignment"]["explained"]) == (None, 1)
    assert report["screen_filter"] == {"variance": 0.3, "compensate": False}
    assert b"screen_filter" not in (tmp_path / "dial.ply").read_bytes()
    assert set(report["config"]) == set(AdaptConfig.__dataclass_fields__) and report["config"]["max_sv"] == 4
    assert report["attenuation"]["max_sv"] == 4
    assert set(report["machine"]) >= {"cpu", "cores", "python", "torch", "numba"}
    assert set(report["seconds"]) == {"load", "kernels", "plan", "start", "train", "evaluate", "total"}
    assert report["adapter_bytes"] == (tmp_path / "dial.safetensors").stat().st_size
    assert report["outputs"] == {"ply": "dial.ply", "adapter": "dial.safetensors", "report": "dial.json"}
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 1.5, 2, 3, 4]
    assert [row["kept"] for row in report["base_rows"]] == [300]
    shares = [row["kept_share"] for row in report["rows"]]
    assert shares == sorted(shares, reverse=True) and 0 < shares[-1] < 0.5
    assert columns(tmp_path / "dial.ply")[-2:] == ["sigma_d", "growth_d"]
    for suffix in (".ply", ".safetensors"):  # with the same seed
        assert stripped((tmp_path / f"dial{suffix}").read_bytes()) == stripped(dialled.with_suffix(suffix).read_bytes())
    table = [line.split() for line in done.out.splitlines()[1:9]]
    assert [line[0] for line in table] == ["dial", "base", "1", "1.5", "2", "3", "4", "plain"]
    assert len({len(line) for line in done.out.splitlines()[1:9]}) == 1  # aligned
    assert "plain: dial.ply in a viewer that does not know the dial" in done.out
    view, *images = done.out.replace("\\\n", "").split("next:\n")[1].splitlines()
    scene = f"--images {shlex.quote(str(capture.scene))}"
    assert shlex.split(view) == shlex.split(f"clod-adapt view dial.ply --base {shlex.quote(str(capture.ply))} {scene}")
    assert [shlex.split(line) for line in images] == [shlex.split(f"clod-adapt eval dial.ply {scene} --sv 1 4")]
    assert "300 Gaussians, SH degree 1" in done.err and "8 photographs to train on, 2 held out, 64x48" in done.err
    assert "trained 12 steps" in done.err and "\r" not in done.err


def test_progress_has_an_estimate(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clod_adapter.cli.shared.console.LINE_EVERY", 0)
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    assert re.search(r"^training   8%, \d.* left, 1/12$", done.err, re.M), done
    assert re.search(r"^base: \d+\.\d\d dB on the held-out photographs$", done.err, re.M), done
    assert re.search(r"^importance  50%, \d.* left, \d+/\d+$", done.err, re.M), done


def test_forecast_of_time_and_memory(clod: Any, capture: Any) -> None:
    """In a line before training, and with what the run took in the report; short runs have none."""
    words = (capture.ply, "--images", capture.scene, "--max-sv", 2, "--out", "dial.ply", "--json", "--iters")
    done = clod(*words, 100)
    found = json.loads(done.out)["forecast"]
    assert re.search(r"^forecast: \d+ seconds, \d.* [MG]B \(100 steps\)$", done.err, re.M), done
    assert done.err.index("\nforecast: ") < done.err.index("\ntrained 100 steps")
    assert found["steps"] == 100 and found["seconds"] > 0 and found["actual_seconds"] > 0
    assert found["bytes"] == pytest.approx(found["actual_bytes"], rel=1 / 3)
    assert json.loads(clod(*words, 1).out)["forecast"] is None


def test_quiet_json_writes_nothing_to_stderr(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    for words in ((*TINY, "--seed", 4), ("--iters", -1)):
        done = clod(capture.ply, "--images", capture.scene, *words, "--quiet", "--json")
        assert done.err == "" if len(words) > 2 else done.err.count("\n") == 1 and "error" in done.err, done
    assert stripped((tmp_path / "dial.ply").read_bytes()) != stripped(dialled.read_bytes())  # with another seed
    assert clod("eval", "dial.ply", "--images", capture.scene, "--quiet", "--json").err == ""
    assert clod("apply", capture.ply, "dial.safetensors", "-o", "again.ply", "--quiet", "--json").err == ""


def test_report_agrees_with_the_files(clod: Any, capture: Any, dialled: Path) -> None:
    """PSNR and SSIM at both ends of the dial and without it, and the calibration."""
    report = json.loads(dialled.with_suffix(".json").read_text())
    model, views = clod_adapter.load(dialled), clod_adapter.load_scene(capture.scene).test
    (want,) = clod_adapter.evaluate(clod_adapter.detach(model.gaussians), views, [1.0])
    assert {**report["detached_row"], "frame_ms": 0} == {**want.as_dict(), "frame_ms": 0} and want.kept == 300
    evaluated = json.loads(clod("eval", dialled, "--images", capture.scene, "--sv", 1, 4, "--json").out)
    for ours, theirs in zip([report["rows"][0], report["rows"][-1]], evaluated["rows"], strict=True):
        assert {**ours, "frame_ms": 0} == {**theirs, "frame_ms": 0}
    stored = model.calibration
    assert stored is not None and stored == clod_adapter.load_adapter(dialled.with_suffix(".safetensors")).calibration
    assert stored.as_dict() == report["calibration"]
    for row, measured in zip(stored.rows, report["rows"], strict=True):
        assert vars(row).items() <= measured.items()
    assert (stored.total, stored.views, stored.width, stored.height) == (300, 2, 64, 48)
    assert stored.machine == machine_name() and report["ply_bytes"] == dialled.stat().st_size


def test_default_output_name_and_device(clod: Any, capture: Any, tmp_path: Path) -> None:
    done = clod(capture.ply, "--images", capture.scene, "--iters", 0, "--device", "cpu", "--quiet")
    assert done.code == 0 and names(tmp_path) == ["base_clod.json", "base_clod.ply", "base_clod.safetensors"]
    assert done.err == "" and done.out.splitlines()[2].split()[0] == "base"
    assert json.loads((tmp_path / "base_clod.json").read_text())["device"] == "cpu"


def test_without_growth_sigma_d_is_written_alone(clod: Any, capture: Any, tmp_path: Path) -> None:
    assert clod(capture.ply, "--images", capture.scene, *TINY, "--form", "paper", "--quiet").code == 0
    assert columns(tmp_path / "dial.ply")[-1] == "sigma_d"
    assert clod_adapter.load_adapter("dial.safetensors").growth_d is None
    with safe_open("dial.safetensors", "pt") as file:
        assert "growth_d" not in set(file.keys())


def test_dial_of_the_checkpoint_is_continued(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """Its growth is dropped with --growth off, which a note says; a dial without growth starts with exponents of 0."""
    given = ("--images", capture.scene, "--max-sv", 4, "--json", "--iters")
    for model, out, more, note in (
        (dialled, "again", (2,), "sigma_d and growth_d"),
        (dialled, "off", (0, "--growth", "off"), "sigma_d; its growth_d is dropped, as growth is off"),
        ("off.ply", "on", (0,), "sigma_d"),
    ):
        done = clod(model, *given, *more, "--out", f"{out}.ply")
        noted = f"{model} has a dial already: continuing from its {note}"
        assert done.code == 0 and noted in json.loads(done.out)["notes"], done
        assert clod("apply", model, f"{out}.safetensors", "-o", "same.ply").code == 0
        assert (tmp_path / "same.ply").read_bytes() == (tmp_path / f"{out}.ply").read_bytes()
    assert columns(tmp_path / "off.ply")[-1] == "sigma_d"
    growth_d = clod_adapter.load(tmp_path / "on.ply").gaussians.growth_d
    assert growth_d is not None and not growth_d.any()


def test_interrupt_of_the_measurement_keeps_finished_rows(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = measure.evaluate

    def evaluate(gaussians: Any, views: Any, dials: list[float], progress: Any, **rest: Any) -> Any:
        pressed = pressing(progress, signal.SIGINT, at=3 * len(views) + 1)
        return real(gaussians, views, dials, progress=pressed if len(dials) == 5 else progress, **rest)

    monkeypatch.setattr(measure, "evaluate", evaluate)
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and [row["virtual_scale"] for row in report["rows"]] == [1, 1.5, 2]
    assert "measurements were interrupted" in report["notes"][0] in done.err and report["interrupted"] is False
    assert report["calibration"] is None and clod_adapter.load(tmp_path / "dial.ply").calibration is None
    assert names(tmp_path) == sorted([*OUTPUTS, STATE])
    done = clod("eval", "dial.ply", "--images", capture.scene, "--psnr-drop", 1)
    assert done.code == 2 and "no calibration in its header" in done.err


def test_interrupt_at_the_end_of_training_skips_the_measurement(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "extract", pressing(run.extract, signal.SIGINT))
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and names(tmp_path) == sorted([*OUTPUTS, STATE]) and report["steps"] == 12
    assert report["rows"] == [] and report["detached_row"] is None and report["interrupted"] is False
    assert "measurements were interrupted" in report["notes"][0] in done.err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    assert clod("apply", capture.ply, "dial.safetensors", "-o", "same.ply").code == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


@pytest.mark.parametrize(("step", "presses"), [("save_adapter", 2), ("save", 1)])
def test_interrupts_of_the_writing(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, presses: int
) -> None:
    """After one the files are written, without a page; after two only the state remains."""
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(run, step, pressing(getattr(run, step), *[signal.SIGINT] * presses))
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--report", "--json")
    assert (done.code, names(tmp_path)) == ((0, OUTPUTS) if presses == 1 else (130, [STATE])), done
    if presses == 1:
        assert json.loads(done.out)["calibration"] and clod_adapter.load(tmp_path / "dial.ply").calibration


def test_outputs_replace_earlier_ones_together(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once, after the measurement, also without a calibration."""
    for name in OUTPUTS:
        (tmp_path / name).write_text(EARLIER)
    save, seen = run.save, []

    def watched(*args: Any, **rest: Any) -> None:
        save(*args, **rest)
        seen.append({(tmp_path / name).read_text() for name in OUTPUTS})

    def infinite(*_: Any) -> None:
        raise ClodError("a PSNR is infinite")

    monkeypatch.setattr(run, "save", watched)
    monkeypatch.setattr(run, "calibrate", infinite)
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    assert done.code == 0 and "the files have no calibration" in done.err, done
    report = json.loads((tmp_path / "dial.json").read_text())
    assert seen == [{EARLIER}] and names(tmp_path) == OUTPUTS and len(report["rows"]) == 5
    assert report["ply_bytes"] == (tmp_path / "dial.ply").stat().st_size and report["calibration"] is None
    assert clod_adapter.load_adapter(tmp_path / "dial.safetensors").calibration is None


def test_without_held_out_photographs(clod: Any, capture: Any, tmp_path: Path) -> None:
    view = clod_adapter.load_scene(capture.scene).train[0]
    (tmp_path / "one" / "images").mkdir(parents=True)
    write_model(tmp_path / "one", [view.camera], ["a.png"])
    Image.fromarray(view.image.numpy()).save(tmp_path / "one" / "images" / "a.png")
    done = clod(capture.ply, "--images", "one", *TINY, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and report["rows"] == report["base_rows"] == [] and "no photographs" in done.err
    assert clod("eval", "dial.ply", "--images", "one").code == 2


def test_without_photographs(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (camera_placement.WIDTH, camera_placement.HEIGHT) == (496, 368)  # smaller here, for speed
    monkeypatch.setattr(camera_placement, "WIDTH", 186)
    monkeypatch.setattr(camera_placement, "HEIGHT", 138)
    done = clod(capture.ply, *TINY, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and names(tmp_path) == OUTPUTS, done
    assert report["scene"] is None and report["teacher"] == "checkpoint" and report["seconds"]["place"] > 0
    assert len(report["notes"]) == 1 and report["notes"][0] in done.err
    assert re.match(r"no photographs: 84 pseudo views to train on, 12 held out, 186x138, ", report["notes"][0])
    assert "held-out photographs" not in done.err and "other coordinates" not in done.err
    next_one = done.err.replace("\\\n", "").split("next:\n")[1].split("\n\n")[0]
    assert shlex.split(next_one) == ["clod-adapt", "view", "dial.ply", "--base", str(capture.ply)]
    # The target images are renders of the base, rounded to bytes.
    assert report["base_rows"][0]["psnr"] > 50 > report["rows"][-1]["psnr"] and len(report["rows"]) == 5
    assert clod("apply", capture.ply, "dial.safetensors", "-o", "same.ply").code == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    assert report["calibration"]["against"] == "checkpoint"
    (note, *_) = json.loads(clod("export", "dial.ply", "--psnr-drop", 1, "-o", "plain.ply", "--json").out)["notes"]
    assert "without photographs, against renders of the checkpoint" in note
    photographs = json.loads(clod("eval", "dial.ply", "--images", capture.scene, "--sv", 1, 4, "--json").out)["rows"]
    assert photographs[0]["psnr"] > 20 and photographs[0]["psnr"] > photographs[1]["psnr"]


def test_invisible_checkpoint_without_photographs_is_refused(clod: Any, capture: Any, tmp_path: Path) -> None:
    unseen = capture.gaussians.replace(opacity_logits=capture.gaussians.opacity_logits - 20)
    done = clod(capture.write(tmp_path / "unseen.ply", unseen), "--out", "dial.ply", "--quiet")
    assert (done.code, done.err.count("\n"), names(tmp_path)) == (2, 1, ["unseen.ply"])
    assert "no camera can be placed" in done.err


def test_report_dials() -> None:
    dials = [1, 1.5, 2, 3, 5, 7, 10, 14, 20]
    for max_sv, want in ((1, [1]), (1.2, [1, 1.2]), (8.5, [*dials[:6], 8.5]), (20, dials)):
        assert report_dials(max_sv) == want


def test_ci_banana(clod: Any, shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    scene = shared_data("ci_banana")
    done = clod(scene / "pretrained.ply", "--images", scene / "images", "--iters", 20, "--out", "dial.ply", "--json")
    assert done.code == 0, done
    report = json.loads(done.out)
    assert report["base_count"] == 20_000 and report["base_rows"][0]["psnr"] == pytest.approx(25.81, abs=0.02)
    assert report["rows"][-1]["kept_share"] < 0.3
    assert clod("apply", scene / "pretrained.ply", "dial.safetensors", "-o", "same.ply").code == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


def test_few_photographs_get_pseudo_views(clod: Any, capture: Any, tmp_path: Path) -> None:
    shutil.copytree(capture.scene, tmp_path / "few")
    names = sorted(path for path in (tmp_path / "few" / "images").iterdir())
    for name in names[1:5]:
        name.unlink()
    done = clod(capture.ply, "--images", "few", "--iters", 2, "--out", "dial.ply", "--json")
    assert done.code == 0, done
    report = json.loads(done.out)
    (note,) = [note for note in report["notes"] if "photographs to train on" in note]
    assert note in done.err and "96 pseudo views" in note
    assert report["config"]["lr_means"] == AdaptConfig().lr_means / 2
    assert report["config"]["lr_sigma"] == AdaptConfig().lr_sigma


def test_faint_gaussians_lower_tau(clod: Any, capture: Any, tmp_path: Path) -> None:
    logits = torch.full_like(capture.gaussians.opacity_logits, -4.6)
    ply = capture.write(tmp_path / "faint.ply", capture.gaussians.replace(opacity_logits=logits))
    done = clod(ply, "--images", capture.scene, "--iters", 2, "--out", "dial.ply", "--json", "--misaligned-ok")
    assert done.code == 0, done
    report = json.loads(done.out)
    assert report["attenuation"]["tau"] < 0.003 and report["config"]["tau"] == 0.02
    assert any("the Gaussians are faint" in note for note in report["notes"])


@pytest.mark.parametrize("photographs", [True, False])
def test_a_result_worse_than_its_base_fails_unless_that_is_accepted(
    capture: Any, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch, photographs: bool
) -> None:
    """The files are written all the same; the last line says by how much, and what to do."""
    monkeypatch.chdir(tmp_path)
    words = [str(capture.ply), *map(str, TINY), "--seed", "1"]
    words += ["--images", str(capture.scene)] if photographs else []
    bad = (-99.0, -98.0) if photographs else (99.0, 98.0)  # any result is
    monkeypatch.setattr(run, "LOST" if photographs else "ENOUGH", bad)
    for more, code in ((["--json"], 1), (["--json", "--accept-loss"], 0)):
        assert main([*words, *more]) == code and (tmp_path / "dial.ply").exists()
        found = json.loads(capsys.readouterr().out)
        assert "dB" in found["loss"] and "train longer (--iters)" in found["loss"]
        base, full = (found[name][0]["psnr"] for name in ("base_rows", "rows"))
        measured = f"is {base - full:.2f} dB below the base" if photographs else f"has {full:.2f} dB against"
        assert f"s = 1 {measured}" in found["loss"]
