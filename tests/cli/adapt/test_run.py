"""The main job: ``clod-adapt PLY --images DIR``."""

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

import clod_adapter
from clod_adapter.cli.adapt import files, inputs, result, setup
from clod_adapter.cli.adapt import report as reporting
from clod_adapter.cli.shared import measure
from clod_adapter.cli.shared.report import machine_name, report_dials
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.scene.colmap import write_model
from clod_adapter.progress import Phase, Progress, tell
from scenes import stripped

THREE = ["dial.json", "dial.ply", "dial.safetensors"]
STATE = "dial.resume.safetensors"
TINY = ("--iters", 12, "--max-sv", 4, "--out", "dial.ply")


EARLIER = "an earlier run's of clod_adapter"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_writes_three_files(clod: Any, capture: Any, tmp_path: Path) -> None:
    before = capture.ply.read_bytes()
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    assert done.code == 0, done
    assert len({path.stat().st_mode for path in tmp_path.iterdir()}) == 1
    assert names(tmp_path) == THREE and capture.ply.read_bytes() == before
    report = json.loads((tmp_path / "dial.json").read_text())
    assert report["command"] == "adapt" and report["version"]
    assert (report["model"], report["scene"]) == (str(capture.ply), str(capture.scene))
    assert (report["base_count"], report["sh_degree"], report["steps"]) == (300, 1, 12)
    assert report["interrupted"] is False and report["notes"] == []
    assert set(report["config"]) == set(AdaptConfig.__dataclass_fields__) and report["config"]["max_sv"] == 4
    assert report["attenuation"]["max_sv"] == 4
    assert set(report["machine"]) >= {"cpu", "cores", "python", "torch", "numba"}
    assert set(report["seconds"]) == {"load", "kernels", "plan", "start", "train", "evaluate", "total"}
    assert report["adapter_bytes"] == (tmp_path / "dial.safetensors").stat().st_size
    assert report["outputs"] == {"ply": "dial.ply", "adapter": "dial.safetensors", "report": "dial.json"}
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 1.25, 1.5, 2, 2.5, 3, 4]
    assert [row["kept"] for row in report["base_rows"]] == [300]
    shares = [row["kept_share"] for row in report["rows"]]
    assert shares == sorted(shares, reverse=True) and 0 < shares[-1] < 0.5
    assert list(PlyData.read(str(tmp_path / "dial.ply"))["vertex"].data.dtype.names or ())[-1] == "sigma_d"


def test_says_what_it_did(clod: Any, capture: Any) -> None:
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    table = [line.split() for line in done.out.splitlines()[1:11]]
    assert [line[0] for line in table] == ["dial", "base", "1", "1.25", "1.5", "2", "2.5", "3", "4", "plain"]
    assert len({len(line) for line in done.out.splitlines()[1:11]}) == 1  # aligned
    assert "plain: dial.ply in a viewer that does not know the dial" in done.out
    assert f"clod-adapt eval dial.ply --images {shlex.quote(str(capture.scene))} --sv 1 4" in done.out
    assert "300 Gaussians, SH degree 1" in done.err and "8 photographs to train on, 2 held out, 64x48" in done.err
    assert "trained 12 steps" in done.err and "\r" not in done.err
    quiet = clod(capture.ply, "--images", capture.scene, *TINY, "--quiet")
    assert (quiet.err, quiet.out.splitlines()[2].split()[:2]) == ("", done.out.splitlines()[2].split()[:2])


def test_progress_has_eta_and_held_out_error(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clod_adapter.cli.shared.console.LINE_EVERY", 0)
    monkeypatch.setattr("clod_adapter.cli.adapt.progress.CHECK_EVERY", 0)
    monkeypatch.setattr("clod_adapter.cli.adapt.progress.CHECK_COST", 1e9)
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    assert re.search(r"^base: \d+\.\d\d dB on the held-out photographs$", done.err, re.M), done
    error, base = r"\d+\.\d\d dB \d+%", r"\d+\.\d\d dB on these \d views"
    assert re.search(r"^importance  50%, \d.* left, 4/8$", done.err, re.M), done
    assert re.search(rf"^training  50%, \d.* left, 6/12, s=1 {error}, s=4 {error}, base {base}$", done.err, re.M), done


def test_json_is_alone_on_stdout(spawn: Any, capture: Any, tmp_path: Path) -> None:
    process = spawn(capture.ply, "--images", capture.scene, *TINY, "--json", cwd=tmp_path)
    out, err = process.communicate(timeout=100)
    assert process.returncode == 0, err
    printed, written = json.loads(out), json.loads((tmp_path / "dial.json").read_text())
    assert out.count("\n") == 1 and printed == written and "base" in err


def test_a_short_run_shows_the_base_error(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clod_adapter.cli.shared.console.LINE_EVERY", 0)
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    assert re.search(r"^training   8%, \d.* left, 1/12, base \d+\.\d\d dB$", done.err, re.M), done


def test_quiet_json_leaves_stderr_alone(clod: Any, capture: Any) -> None:
    for words in (TINY, ("--iters", -1)):
        done = clod(capture.ply, "--images", capture.scene, *words, "--quiet", "--json")
        assert done.err == "" if words is TINY else done.err.count("\n") == 1 and "error" in done.err, done
    assert clod("eval", "dial.ply", "--images", capture.scene, "--quiet", "--json").err == ""
    assert clod("apply", capture.ply, "dial.safetensors", "-o", "again.ply", "--quiet", "--json").err == ""


def test_the_plain_row_is_the_file_without_its_dial(clod: Any, capture: Any, tmp_path: Path) -> None:
    clod(capture.ply, "--images", capture.scene, *TINY)
    report = json.loads((tmp_path / "dial.json").read_text())
    adapted, views = clod_adapter.load(tmp_path / "dial.ply").gaussians, clod_adapter.load_scene(capture.scene).test
    (want,) = clod_adapter.evaluate(clod_adapter.detach(adapted), views, [1.0])
    assert {**report["detached_row"], "frame_ms": 0} == {**want.as_dict(), "frame_ms": 0}
    assert report["detached_row"]["kept"] == 300


@pytest.mark.parametrize("device", ["auto", "cpu"])
def test_device(clod: Any, capture: Any, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = []
    to = clod_adapter.Gaussians.to
    monkeypatch.setattr(clod_adapter.Gaussians, "to", lambda self, where: moved.append(where) or to(self, where))
    done = clod(capture.ply, "--images", capture.scene, "--iters", 0, "--device", device, "--json")
    assert set(moved) == {torch.device("cpu")} and json.loads(done.out)["device"] == "cpu"


def test_apply_of_another_version_gives_the_same_file(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert clod(capture.ply, "--images", capture.scene, *TINY).code == 0
    monkeypatch.setattr("importlib.metadata.version", lambda name: "99.0")
    assert clod("--version").out == "clod-adapt 99.0\n"
    assert clod("apply", capture.ply, "dial.safetensors", "-o", "same.ply").code == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


def test_default_name(clod: Any, capture: Any, tmp_path: Path) -> None:
    assert clod(capture.ply, "--images", capture.scene, "--iters", 0, "--quiet").code == 0
    assert names(tmp_path) == ["base_clod.json", "base_clod.ply", "base_clod.safetensors"]


def test_same_seed_same_files(clod: Any, capture: Any, tmp_path: Path) -> None:
    files = []
    for seed in (3, 3, 4):
        assert clod(capture.ply, "--images", capture.scene, *TINY, "--seed", seed, "--quiet").code == 0
        files.append([(tmp_path / name).read_bytes() for name in THREE[1:]])
    first, second, other = ([stripped(data) for data in pair] for pair in files)
    assert first == second and first[0] != other[0]


def test_reported_quality_is_that_of_the_file(clod: Any, capture: Any, tmp_path: Path) -> None:
    clod(capture.ply, "--images", capture.scene, *TINY)
    report = json.loads((tmp_path / "dial.json").read_text())
    evaluated = json.loads(clod("eval", "dial.ply", "--images", capture.scene, "--sv", 1, 4, "--json").out)
    for ours, theirs in zip([report["rows"][0], report["rows"][-1]], evaluated["rows"], strict=True):
        assert {**ours, "frame_ms": 0} == {**theirs, "frame_ms": 0}


def test_continues_from_sigma_d(clod: Any, capture: Any, tmp_path: Path) -> None:
    clod(capture.ply, "--images", capture.scene, *TINY)
    again = clod("dial.ply", "--images", capture.scene, "--iters", 2, "--max-sv", 4, "--out", "again.ply")
    assert again.code == 0 and "continuing from its sigma_d" in again.err
    assert clod("apply", "dial.ply", "again.safetensors", "-o", "same.ply").code == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "again.ply").read_bytes()


def test_time_budget(clod: Any, capture: Any, tmp_path: Path) -> None:
    done = clod(capture.ply, "--images", capture.scene, "--iters", 10**6, "--time-budget", 1, "--out", "dial.ply")
    report = json.loads((tmp_path / "dial.json").read_text())
    assert done.code == 0 and 0 < report["steps"] < 10**6
    assert 0.9 < report["seconds"]["train"] < 3  # a budget ends after the step under way


def test_interrupt_leaves_a_usable_result(spawn: Any, capture: Any, tmp_path: Path, clod: Any) -> None:
    words = (capture.ply, "--images", capture.scene, "--iters", 10**6, "--out", "dial.ply", "--json")
    process = spawn(*words, cwd=tmp_path, line_every=0.1)
    while not (line := process.stderr.readline()).startswith("training"):
        assert line, process.communicate()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0 and "interrupted after" in err, err
    report = json.loads(out)
    assert report["interrupted"] is True and 0 < report["steps"] < 10**6 and len(report["rows"]) > 3
    assert names(tmp_path) == sorted([*THREE, STATE])
    assert clod_adapter.load(tmp_path / "dial.ply").gaussians.sigma_d is not None
    assert clod("apply", capture.ply, "dial.safetensors", "-o", "same.ply").code == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


@pytest.mark.parametrize("presses", [1, 2])
def test_interrupt_with_nothing_to_write(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, presses: int
) -> None:
    """One press before training, or two while it runs."""

    def adapt(base: Any, scene: Any, config: Any, progress: Any, resume: Any, **rest: Any) -> Any:
        for _ in range(presses):
            signal.raise_signal(signal.SIGINT)
        tell(progress, Phase.IMPORTANCE, 1, 8)
        pytest.fail("continued")

    monkeypatch.setattr("clod_adapter.training.plan.adapt", adapt)
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    assert done.code == 130 and done.err.splitlines()[-1] == "clod-adapt: interrupted"
    assert names(tmp_path) == [] and signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_interrupt_of_the_measuring(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The frame is finished, and what is measured by then is reported."""
    real = measure.evaluate

    def evaluate(gaussians: Any, views: Any, dials: list[float], progress: Any, **rest: Any) -> Any:
        def press(now: Progress) -> Any:
            if now.total == 7 * len(views) and now.done == 3 * len(views) + 1:
                signal.raise_signal(signal.SIGINT)
            return progress(now)

        return real(gaussians, views, dials, progress=press, **rest)

    monkeypatch.setattr(measure, "evaluate", evaluate)
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and [row["virtual_scale"] for row in report["rows"]] == [1, 1.25, 1.5]
    assert "measurements were interrupted" in report["notes"][0] in done.err and report["interrupted"] is False
    assert report["calibration"] is None and clod_adapter.load(tmp_path / "dial.ply").calibration is None
    assert names(tmp_path) == sorted([*THREE, STATE])
    done = clod("eval", "dial.ply", "--images", capture.scene, "--psnr-drop", 1)
    assert done.code == 2 and "no calibration in its header" in done.err


def test_an_interrupt_at_the_end_of_training_skips_the_measurement(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    press_during(monkeypatch, result, "extract", 1)
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and names(tmp_path) == sorted([*THREE, STATE]) and report["steps"] == 12
    assert report["rows"] == [] and report["detached_row"] is None and report["interrupted"] is False
    assert "measurements were interrupted" in report["notes"][0] in done.err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    assert clod("apply", capture.ply, "dial.safetensors", "-o", "same.ply").code == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


@pytest.mark.parametrize("presses", [1, 2])
@pytest.mark.parametrize(("module", "step"), [(files, "save_adapter"), (files, "save"), (reporting, "calibrate")])
def test_an_interrupt_of_the_writing(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, step: str, presses: int
) -> None:
    """One press lets it finish, without a page; two leave the state."""
    pytest.importorskip("matplotlib")
    press_during(monkeypatch, module, step, presses)
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--report", "--json")
    assert (done.code, names(tmp_path)) == ((0, THREE) if presses == 1 else (130, [STATE])), done
    if presses == 1:
        assert json.loads(done.out)["calibration"] and clod_adapter.load(tmp_path / "dial.ply").calibration


def press_during(monkeypatch: pytest.MonkeyPatch, module: Any, step: str, presses: int) -> None:
    """Ctrl-C at the beginning of a step of the command."""
    real = getattr(module, step)

    def interrupted(*args: Any, **rest: Any) -> Any:
        for _ in range(presses):
            signal.raise_signal(signal.SIGINT)
        return real(*args, **rest)

    monkeypatch.setattr(module, step, interrupted)


def test_a_report_is_of_the_files_beside_it(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An earlier run's stays with its files until all three are replaced, once, after they are measured."""
    for name in THREE:
        (tmp_path / name).write_text(EARLIER)
    save, seen = files.save, []

    def watched(*args: Any, **rest: Any) -> None:
        save(*args, **rest)
        seen.append({(tmp_path / name).read_text() for name in THREE})

    monkeypatch.setattr(files, "save", watched)
    assert clod(capture.ply, "--images", capture.scene, *TINY).code == 0
    report = json.loads((tmp_path / "dial.json").read_text())
    assert seen == [{EARLIER}] and names(tmp_path) == THREE and len(report["rows"]) == 7
    assert report["ply_bytes"] == (tmp_path / "dial.ply").stat().st_size


@pytest.mark.parametrize("step", ["save_adapter", "save", "write_report"])
def test_a_full_disk_leaves_the_earlier_files(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """All three of them, whichever of the new ones does not fit; and the state, to go on from once there is space."""
    for name in THREE:
        (tmp_path / name).write_text(EARLIER)

    def full(path: Path, *_: Any, **rest: Any) -> None:
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"half")
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, step, full)
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    name = {"save_adapter": "dial.safetensors", "save": "dial.ply", "write_report": "dial.json"}[step]
    assert done.code == 2 and f"error: {name}: cannot be written: No space left on device" in done.err
    assert names(tmp_path) == sorted([*THREE, STATE])
    assert all((tmp_path / name).read_text() == EARLIER for name in THREE)


def test_an_unusable_config_fails_before_the_work(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(setup, "asdict", lambda config: {"time_budget": float("inf")})
    monkeypatch.setattr(inputs, "read_checkpoint", lambda *_: pytest.fail("read"))
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    assert done.code == 2 and "not plain JSON" in done.err


def test_without_held_out_photographs(clod: Any, capture: Any, tmp_path: Path) -> None:
    view = clod_adapter.load_scene(capture.scene).train[0]
    (tmp_path / "one" / "images").mkdir(parents=True)
    write_model(tmp_path / "one", [view.camera], ["a.png"])
    Image.fromarray(view.image.numpy()).save(tmp_path / "one" / "images" / "a.png")
    done = clod(capture.ply, "--images", "one", *TINY, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and report["rows"] == report["base_rows"] == [] and "no photographs" in done.err
    assert clod("eval", "dial.ply", "--images", "one").code == 2


def test_without_photographs(clod: Any, capture: Any, tmp_path: Path) -> None:
    done = clod(capture.ply, *TINY, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and names(tmp_path) == THREE, done
    assert report["scene"] is None and report["teacher"] == "checkpoint" and report["seconds"]["place"] > 0
    assert len(report["notes"]) == 1 and report["notes"][0] in done.err
    assert re.match(r"no photographs: 84 pseudo views to train on, 12 held out, 496x368, ", report["notes"][0])
    assert "held-out photographs" not in done.err and "other coordinates" not in done.err
    assert re.search(r"if there are any:\n  clod-adapt eval dial.ply --images DIR --sv 1 4$", done.err, re.M)
    # The teacher is the base itself, but for the rounding to bytes.
    assert report["base_rows"][0]["psnr"] > 50 > report["rows"][-1]["psnr"] and len(report["rows"]) == 7
    assert clod("apply", capture.ply, "dial.safetensors", "-o", "same.ply").code == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    assert report["calibration"]["against"] == "checkpoint"
    (note, *_) = json.loads(clod("export", "dial.ply", "--psnr-drop", 1, "-o", "plain.ply", "--json").out)["notes"]
    assert "against renders of the checkpoint" in note
    photographs = json.loads(clod("eval", "dial.ply", "--images", capture.scene, "--sv", 1, 4, "--json").out)["rows"]
    assert photographs[0]["psnr"] > 20 and photographs[0]["psnr"] > photographs[1]["psnr"]


def test_a_checkpoint_that_shows_nothing_cannot_be_its_own_teacher(clod: Any, capture: Any, tmp_path: Path) -> None:
    unseen = capture.gaussians.replace(opacity_logits=capture.gaussians.opacity_logits - 20)
    done = clod(capture.write(tmp_path / "unseen.ply", unseen), "--out", "dial.ply", "--quiet")
    assert (done.code, done.err.count("\n"), names(tmp_path)) == (2, 1, ["unseen.ply"])
    assert "no camera can be placed" in done.err


@pytest.mark.parametrize(
    ("max_sv", "dials"),
    [
        (1, [1]),
        (1.2, [1, 1.2]),
        (5, [1, 1.25, 1.5, 2, 2.5, 3, 4, 5]),
        (8.5, [1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 7, 8.5]),
        (20, [1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 7, 10, 14, 20]),
    ],
)
def test_report_dials(max_sv: float, dials: list[float]) -> None:
    assert report_dials(max_sv) == dials


def test_ci_banana(clod: Any, shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    scene = shared_data("ci_banana")
    done = clod(scene / "pretrained.ply", "--images", scene / "images", "--iters", 20, "--out", "dial.ply", "--json")
    assert done.code == 0, done
    report = json.loads(done.out)
    assert report["base_count"] == 20_000 and report["base_rows"][0]["psnr"] == pytest.approx(25.81, abs=0.02)
    assert report["rows"][-1]["kept_share"] < 0.3
    assert clod("apply", scene / "pretrained.ply", "dial.safetensors", "-o", "same.ply").code == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


def test_the_calibration_is_in_all_three_files(clod: Any, capture: Any, tmp_path: Path) -> None:
    assert clod(capture.ply, "--images", capture.scene, *TINY).code == 0
    report = json.loads((tmp_path / "dial.json").read_text())
    stored = clod_adapter.load(tmp_path / "dial.ply").calibration
    assert stored is not None and stored == clod_adapter.load_adapter(tmp_path / "dial.safetensors").calibration
    assert stored.as_dict() == report["calibration"]
    for row, measured in zip(stored.rows, report["rows"], strict=True):
        assert vars(row).items() <= measured.items()
    assert (stored.total, stored.views, stored.width, stored.height) == (300, 2, 64, 48)
    assert stored.machine == machine_name()
    assert report["ply_bytes"] == (tmp_path / "dial.ply").stat().st_size


def test_without_a_calibration_the_files_are_written_all_the_same(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def infinite(*_: Any) -> None:
        raise ClodError("a PSNR is infinite")

    monkeypatch.setattr(reporting, "calibrate", infinite)
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and "the files have no calibration" in done.err and len(report["rows"]) == 7
    assert report["calibration"] is None and names(tmp_path) == THREE
    assert clod_adapter.load_adapter(tmp_path / "dial.safetensors").calibration is None


def test_few_photographs_get_pseudo_views(clod: Any, capture: Any, tmp_path: Path) -> None:
    shutil.copytree(capture.scene, tmp_path / "few")
    names = sorted(path for path in (tmp_path / "few" / "images").iterdir())
    for name in names[1:5]:
        name.unlink()
    done = clod(capture.ply, "--images", "few", "--iters", 2, "--out", "dial.ply", "--json")
    assert done.code == 0, done
    report = json.loads(done.out)
    (note,) = [note for note in report["notes"] if "photographs to train on" in note]
    assert note in done.err and "16 pseudo views" in note
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
