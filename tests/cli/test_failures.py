"""Errors during and after training: the state is saved, and the message names the step that --resume starts from."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
from clod_adapter.cli.adapt import listeners
from clod_adapter.cli.adapt import run as adapt_run
from clod_adapter.cli.adapt.listeners import ProgressDisplay
from clod_adapter.cli.shared import pages
from clod_adapter.errors import ClodError
from clod_adapter.progress import Phase, Progress
from runs import OUTPUTS, STATE, change_step, fail, names
from scenes import stripped

ITERS = 12
TINY = ("--iters", ITERS, "--max-sv", 4, "--out")


@pytest.fixture
def words(capture: Any) -> list[Any]:
    return [capture.ply, "--images", capture.scene, *TINY, "dial.ply"]


@pytest.fixture(scope="module")
def whole(dialled: Path) -> dict[str, bytes]:
    """The files of a run without an error."""
    return {suffix: stripped(dialled.with_suffix(suffix).read_bytes()) for suffix in (".ply", ".safetensors")}


def assert_resumes(clod: Any, words: list[Any], folder: Path, step: int, whole: dict[str, bytes]) -> None:
    """With --resume the same command starts from ``step``, and writes the files of a run without an error."""
    done = clod(*words, "--resume")
    assert done.code == 0 and f"resuming {STATE} from step {step}" in done.err, done
    assert names(folder) == OUTPUTS
    for suffix, want in whole.items():
        assert stripped((folder / f"dial{suffix}").read_bytes()) == want, suffix


def raising(error: Exception) -> Any:
    def call(*_: Any, **__: Any) -> None:
        raise error

    return call


def after_step(patch: pytest.MonkeyPatch, step: int, action: Any) -> None:
    """Calls ``action`` after a step, as the page and the held-out check are called."""
    call = ProgressDisplay.__call__

    def listening(self: ProgressDisplay, progress: Progress) -> bool:
        going = call(self, progress)
        if progress.phase == Phase.TRAINING and progress.done == step:
            action()
        return going

    patch.setattr(ProgressDisplay, "__call__", listening)


@pytest.mark.parametrize(
    ("broken", "code", "step"),
    [
        (lambda patch: change_step(patch, 6, fail), 1, 5),
        (lambda patch: after_step(patch, 7, fail), 1, 7),
        (lambda patch: patch.setattr(adapt_run, "measure_result", fail), 1, ITERS),
        (lambda patch: patch.setattr(adapt_run, "save", raising(ClodError("dial.ply: cannot be written"))), 2, ITERS),
        (lambda patch: patch.setattr(adapt_run, "save", raising(MemoryError())), 2, ITERS),
        (lambda patch: patch.setattr(adapt_run, "save", fail), 1, ITERS),
    ],
    ids=["step, quiet", "listener", "measuring", "full disk", "memory", "writing"],
)
def test_resuming_after_an_error(
    clod: Any, words: list[Any], whole: Any, tmp_path: Path, broken: Any, code: int, step: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        broken(patch)
        done = clod(*words, *(["--quiet"] if step == 5 else []))
    assert done.code == code and names(tmp_path) == [STATE], done
    assert f"--resume resumes from step {step}, which is in {STATE}\n" in done.err
    assert ("please report it" in done.err) == ("ZeroDivisionError: of ours" in done.err) == (code == 1)
    assert_resumes(clod, words, tmp_path, step, whole)


def test_non_finite_loss(clod: Any, words: list[Any], whole: Any, tmp_path: Path) -> None:
    """The result before that step is written, and the exit code is 1."""
    with pytest.MonkeyPatch.context() as patch:
        change_step(patch, 6, lambda found: replace(found, loss=math.nan))
        done = clod(*words, "--json")
    report = json.loads(done.out)
    assert done.code == 1 and names(tmp_path) == sorted([*OUTPUTS, STATE]), done
    assert report["interrupted"] and report["steps"] == 5 and len(report["rows"]) > 2
    assert any("the result so far is written: the loss of step 6 is not finite" in n for n in report["notes"])
    assert clod_adapter.load(tmp_path / "dial.ply").gaussians.sigma_d.isfinite().all()
    assert_resumes(clod, words, tmp_path, 5, whole)


def test_non_finite_gradients(clod: Any, words: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(found: Any) -> Any:
        found.gradients["quats"][5] = math.nan
        return found

    change_step(monkeypatch, 6, spoil)
    done = clod(*words)
    assert done.code == 0 and "1 Gaussians were not moved by some steps: their gradients" in done.err, done
    found = clod_adapter.load(tmp_path / "dial.ply").gaussians
    assert all(value.isfinite().all() for value in found.tensors().values())


def test_error_in_the_page(clod: Any, words: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All other files are written, and no state remains."""
    monkeypatch.setattr(pages.AdaptPage, "write", fail)
    done = clod(*words, "--report")
    assert done.code == 1 and names(tmp_path) == OUTPUTS and "--resume" not in done.err, done
    assert len(json.loads((tmp_path / "dial.json").read_text())["rows"]) > 2


@pytest.fixture
def outside(capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Arguments of a run with separate folders for outputs and temporary files."""
    for name in ("temporary", "out"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return [capture.ply, "--images", capture.scene, *TINY, "out/dial.ply"]


def test_removed_output_folder(clod: Any, outside: list[Any], whole: Any, tmp_path: Path) -> None:
    """The state is in the folder for temporary files; moved to its place it is resumed."""
    with pytest.MonkeyPatch.context() as patch:
        after_step(patch, 4, lambda: shutil.rmtree("out"))
        done = clod(*outside)
    (kept,) = tmp_path.glob(f"temporary/*/{STATE}")
    said = f"step {ITERS} is in {kept}: move it to out/{STATE}, and --resume resumes from there"
    assert done.code == 2 and done.err.splitlines()[-2] == said, done
    assert "error: out/dial.safetensors: folder out does not exist; create it first" in done.err.splitlines()[-1]
    (tmp_path / "out").mkdir()
    shutil.move(kept, tmp_path / "out" / STATE)
    done = clod(*outside, "--resume")
    assert done.code == 0 and names(tmp_path / "out") == OUTPUTS, done
    assert stripped((tmp_path / "out" / "dial.ply").read_bytes()) == whole[".ply"]


def test_state_that_cannot_be_saved(clod: Any, outside: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the error of the output is printed."""
    (tmp_path / "temporary").rmdir()
    monkeypatch.setattr(adapt_run, "save_adapter", lambda *_: shutil.rmtree("out") or fail())
    monkeypatch.setattr(listeners, "save_state", raising(ClodError("full")))
    done = clod(*outside)
    assert done.code == 1 and "ZeroDivisionError: of ours" in done.err and "resumes from" not in done.err, done


def test_infinite_opacities(clod: Any, capture: Any, tmp_path: Path) -> None:
    """They stay infinite through adapting, resuming, applying, measuring and adapting again."""
    logits = capture.gaussians.opacity_logits.clone()
    logits[3:300:60] = math.inf
    capture.write(tmp_path / "opaque.ply", capture.gaussians.replace(opacity_logits=logits))
    words = ["opaque.ply", "--images", capture.scene, *TINY]
    done = clod(*words, "dial.ply", "--json")
    assert done.code == 0 and "5 Gaussians have opacity = +inf" in done.err, done
    assert all(math.isfinite(row["psnr"]) for row in json.loads(done.out)["rows"])
    found = clod_adapter.load(tmp_path / "dial.ply").gaussians.opacity_logits
    assert torch.equal(found.isposinf(), logits.isposinf()) and not found.isnan().any()
    assert clod("apply", "opaque.ply", "dial.safetensors", "-o", "again.ply").code == 0
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        change_step(patch, 12, fail)  # the state has a mean
        assert clod(*words, "next.ply").code == 1
    assert clod(*words, "next.ply", "--resume").code == 0
    assert stripped((tmp_path / "next.ply").read_bytes()) == stripped((tmp_path / "dial.ply").read_bytes())
    assert clod("dial.ply", "--images", capture.scene, *TINY, "next.ply", "--trim").code == 0
    assert clod_adapter.load(tmp_path / "next.ply").gaussians.opacity_logits.isposinf().sum() == 5
