"""Whatever fails while or after a training, nothing of it is lost, and it is said what goes on from where."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
from clod_adapter.cli.adapt import files
from clod_adapter.cli.adapt import report as reporting
from clod_adapter.cli.adapt.progress import ProgressDisplay
from clod_adapter.cli.shared import pages
from clod_adapter.errors import ClodError
from clod_adapter.progress import Phase, Progress
from clod_adapter.training.objective import Objective
from clod_adapter.training.state_file import load_state
from scenes import stripped

OUTPUTS = ["dial.json", "dial.ply", "dial.safetensors"]
STATE = "dial.resume.safetensors"
ITERS = 12
TINY = ("--iters", ITERS, "--max-sv", 4, "--out")
WHOLE: dict[str, bytes] = {}


@pytest.fixture
def words(capture: Any) -> list[Any]:
    return [capture.ply, "--images", capture.scene, *TINY, "dial.ply"]


@pytest.fixture
def whole(clod: Any, capture: Any, tmp_path: Path) -> dict[str, bytes]:
    """What a run leaves that nothing happens to; run once."""
    if not WHOLE:
        assert clod(capture.ply, "--images", capture.scene, *TINY, "whole.ply").code == 0
        for kind in ("ply", "safetensors"):
            WHOLE[kind] = stripped((tmp_path / f"whole.{kind}").read_bytes())
            (tmp_path / f"whole.{kind}").unlink()
        (tmp_path / "whole.json").unlink()
    return WHOLE


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def assert_goes_on(clod: Any, words: list[Any], folder: Path, step: int, whole: dict[str, bytes]) -> None:
    """The same command with --resume goes on from ``step``, and ends as an undisturbed run does."""
    done = clod(*words, "--resume")
    assert done.code == 0 and f"resuming {STATE} from step {step}" in done.err, done
    assert names(folder) == OUTPUTS
    for kind, want in whole.items():
        assert stripped((folder / f"dial.{kind}").read_bytes()) == want, kind


def pull_changed(patch: pytest.MonkeyPatch, at: int, change: Callable[[Any], Any]) -> None:
    """The ``at``-th pull of the run is what ``change`` makes of it; kernels are prepared by another run."""
    pull, pulls = Objective.gradient_sum, count(1)

    def changed(self: Objective, *given: Any) -> Any:
        found = pull(self, *given)
        return change(found) if self.config.iters == ITERS and next(pulls) == at else found

    patch.setattr(Objective, "gradient_sum", changed)


def fail(*_: Any, **__: Any) -> Any:
    raise ZeroDivisionError("of ours")


@pytest.mark.parametrize("quiet", [(), ("--quiet",)])
def test_an_error_while_training(
    clod: Any, words: list[Any], whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quiet: Any
) -> None:
    with monkeypatch.context() as patch:
        pull_changed(patch, 6, fail)
        done = clod(*words, *quiet)
    assert done.code == 1 and names(tmp_path) == [STATE], done
    assert "ZeroDivisionError: of ours" in done.err and "please report it" in done.err.splitlines()[-1]
    assert f"--resume resumes from step 5, which is in {STATE}\n" in done.err
    assert_goes_on(clod, words, tmp_path, 5, whole)


def test_an_error_of_what_follows_the_training(
    clod: Any, words: list[Any], whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as the page, or the look at the held-out views."""
    call = ProgressDisplay.__call__

    def failing(self: ProgressDisplay, progress: Progress) -> bool:
        going = call(self, progress)
        if progress.phase == Phase.TRAINING and progress.done == 7:
            fail()
        return going

    with monkeypatch.context() as patch:
        patch.setattr(ProgressDisplay, "__call__", failing)
        done = clod(*words)
    assert done.code == 1 and names(tmp_path) == [STATE] and "resumes from step 7" in done.err, done
    assert_goes_on(clod, words, tmp_path, 7, whole)


def test_a_loss_that_is_not_finite(
    clod: Any, words: list[Any], whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was learned before is written, with a code that says that the run has not ended well."""
    with monkeypatch.context() as patch:
        pull_changed(patch, 6, lambda pull: replace(pull, loss=math.nan))
        done = clod(*words, "--json")
    report = json.loads(done.out)
    assert done.code == 1 and names(tmp_path) == sorted([*OUTPUTS, STATE]), done
    assert report["interrupted"] and report["steps"] == 5 and len(report["rows"]) > 2
    assert any("the result so far is written: the loss of step 6 is not finite" in n for n in report["notes"])
    assert clod_adapter.load(tmp_path / "dial.ply").gaussians.sigma_d.isfinite().all()
    assert_goes_on(clod, words, tmp_path, 5, whole)


def test_gradients_that_are_not_finite_are_told(
    clod: Any, words: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(pull: Any) -> Any:
        pull.gradients["quats"][5] = math.nan
        return pull

    pull_changed(monkeypatch, 6, spoil)
    done = clod(*words)
    assert done.code == 0 and "1 Gaussians were not moved by some steps: their gradients" in done.err, done
    found = clod_adapter.load(tmp_path / "dial.ply").gaussians
    assert all(value.isfinite().all() for value in found.tensors().values())


@pytest.mark.parametrize(
    ("error", "code"),
    [(ClodError("dial.ply: cannot be written: No space left on device"), 2), (OSError(5, "Input/output error"), 2),
     (MemoryError(), 2), (ValueError("in a writer"), 1)],
    ids=["full", "io", "memory", "unknown"],
)  # fmt: skip
def test_an_error_while_writing(
    clod: Any, words: list[Any], whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Any, code: int
) -> None:
    def raising(*_: Any, **__: Any) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(files, "save", raising)
        done = clod(*words)
    assert done.code == code and names(tmp_path) == [STATE], done
    assert load_state(tmp_path / STATE)[0].steps == ITERS and f"--resume resumes from step {ITERS}, which" in done.err
    assert ("please report it" in done.err) == (code == 1)
    assert_goes_on(clod, words, tmp_path, ITERS, whole)


def test_an_error_while_measuring(
    clod: Any, words: list[Any], whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state is saved by then."""
    with monkeypatch.context() as patch:
        patch.setattr(reporting, "measure_result", fail)
        done = clod(*words)
    assert done.code == 1 and names(tmp_path) == [STATE], done
    assert_goes_on(clod, words, tmp_path, ITERS, whole)


def test_an_error_while_the_page_is_written(
    clod: Any, words: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All else is there by then, and nothing to go on from."""
    monkeypatch.setattr(pages.AdaptPage, "write", fail)
    done = clod(*words, "--report")
    assert done.code == 1 and names(tmp_path) == OUTPUTS and "--resume" not in done.err, done
    assert len(json.loads((tmp_path / "dial.json").read_text())["rows"]) > 2


def test_a_folder_that_is_gone(
    clod: Any, capture: Any, whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was learned is where temporary files go; moved to where it belongs it is gone on from."""
    (tmp_path / "temporary").mkdir()
    (tmp_path / "out").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    words = [capture.ply, "--images", capture.scene, *TINY, "out/dial.ply"]
    call = ProgressDisplay.__call__

    def removing(self: ProgressDisplay, progress: Progress) -> bool:
        going = call(self, progress)
        if progress.phase == Phase.TRAINING and progress.done == 4:
            shutil.rmtree("out")
        return going

    with monkeypatch.context() as patch:
        patch.setattr(ProgressDisplay, "__call__", removing)
        done = clod(*words)
    (kept,) = tmp_path.glob(f"temporary/*/{STATE}")
    said = f"step {ITERS} is in {kept}: move it to out/{STATE}, and --resume resumes from there"
    assert done.code == 2 and done.err.splitlines()[-2] == said, done
    assert "error: out/dial.safetensors: folder out does not exist; create it first" in done.err.splitlines()[-1]
    (tmp_path / "out").mkdir()
    shutil.move(kept, tmp_path / "out" / STATE)
    done = clod(*words, "--resume")
    assert done.code == 0 and names(tmp_path / "out") == OUTPUTS, done
    assert stripped((tmp_path / "out" / "dial.ply").read_bytes()) == whole["ply"]


def test_nowhere_to_save(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one error is that of the output."""
    (tmp_path / "out").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    monkeypatch.setattr(reporting, "write", lambda *_: shutil.rmtree("out") or fail())
    monkeypatch.setattr(
        "clod_adapter.cli.adapt.resume.save_state", lambda path, *_: (_ for _ in ()).throw(ClodError("full"))
    )
    done = clod(capture.ply, "--images", capture.scene, *TINY, "out/dial.ply")
    assert done.code == 1 and "ZeroDivisionError: of ours" in done.err and "goes on from" not in done.err, done


def test_infinite_opacities(clod: Any, capture: Any, tmp_path: Path) -> None:
    """A file with five of them is adapted, resumed, applied and measured, and they stay as they are."""
    logits = capture.gaussians.opacity_logits.clone()
    logits[3:300:60] = math.inf
    capture.write(tmp_path / "opaque.ply", capture.gaussians.replace(opacity_logits=logits))
    words = ["opaque.ply", "--images", capture.scene, *TINY, "dial.ply"]
    for more in ((), ("--trim",), ("--form", "paper")):
        done = clod(*words, *more, "--json")
        assert done.code == 0 and "5 Gaussians have opacity = +inf" in done.err, done
        assert all(math.isfinite(row["psnr"]) for row in json.loads(done.out)["rows"])
        found = clod_adapter.load(tmp_path / "dial.ply").gaussians.opacity_logits
        assert found.isposinf().sum() == 5 and not found.isnan().any()
        assert clod("apply", "opaque.ply", "dial.safetensors", "-o", "again.ply").code == 0
        assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    assert torch.equal(found.isposinf(), logits.isposinf())
    assert clod("dial.ply", "--images", capture.scene, *TINY, "next.ply").code == 0  # going on from its dial
    assert clod_adapter.load(tmp_path / "next.ply").gaussians.opacity_logits.isposinf().sum() == 5


def test_infinite_opacities_are_resumed(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logits = capture.gaussians.opacity_logits.clone()
    logits[::70] = math.inf
    capture.write(tmp_path / "opaque.ply", capture.gaussians.replace(opacity_logits=logits))
    words = ["opaque.ply", "--images", capture.scene, *TINY]
    assert clod(*words, "whole.ply").code == 0
    with monkeypatch.context() as patch:
        pull_changed(patch, 12, fail)  # by then there is a mean
        assert clod(*words, "dial.ply").code == 1
    assert clod(*words, "dial.ply", "--resume").code == 0
    assert stripped((tmp_path / "dial.ply").read_bytes()) == stripped((tmp_path / "whole.ply").read_bytes())
