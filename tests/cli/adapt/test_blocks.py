"""``--memory`` and ``--block``: one process or many jobs, killed or not, the same files; errors in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
from clod_adapter.blocks import memory
from clod_adapter.blocks.file import load_block
from clod_adapter.blocks.memory import MemoryPlan, plan_for_limit
from clod_adapter.cli.adapt import memory as memory_option
from clod_adapter.cli.adapt import progress as follower
from clod_adapter.cli.adapt import resume
from clod_adapter.progress import Phase, Progress
from clod_adapter.training.objective import Objective
from scenes import stripped

BLOCKS = 3


@pytest.fixture
def forced(monkeypatch: pytest.MonkeyPatch) -> None:
    """What fits is adapted in blocks all the same."""

    def plan(*args: Any) -> MemoryPlan:
        return replace(plan_for_limit(*args), blocks=BLOCKS)

    monkeypatch.setattr(memory_option, "plan_for_limit", plan)


@pytest.fixture
def adapt(clod: Callable[..., Any], capture: Any, forced: None) -> Callable[..., Any]:
    """Runs the main job in blocks."""

    def run(out: str, *more: object) -> Any:
        given = ["--images", capture.scene, "--iters", 9, "--max-sv", 3, "--memory", "8GB", "--out", out]
        return clod(capture.ply, *given, *more)

    return run


WHOLE: dict[str, bytes] = {}


@pytest.fixture
def whole(adapt: Callable[..., Any], tmp_path: Path) -> dict[str, bytes]:
    """What one process leaves; run once."""
    if WHOLE:
        return WHOLE
    (tmp_path / "one.blocks.safetensors").write_bytes(b"the user's")
    done = adapt("one.ply", "--json")
    assert done.code == 0, done
    report = json.loads(done.out)
    assert report["memory"]["blocks"] == BLOCKS and report["steps"] == 27 and len(report["rows"]) > 2
    assert "in 3 blocks" in done.err and "block 3 of 3, pass 1 of 2: 100 Gaussians, 7 steps" in done.err
    assert report["seconds"]["start"] > 0
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == ["one.blocks.safetensors", "one.json", "one.ply", "one.safetensors"]
    (tmp_path / "one.blocks.safetensors").unlink()
    WHOLE.update(outputs(tmp_path, "one"))
    return WHOLE


def outputs(folder: Path, name: str) -> dict[str, bytes]:
    return {suffix: stripped((folder / f"{name}{suffix}").read_bytes()) for suffix in (".ply", ".safetensors")}


def test_jobs_end_as_one_process_does(adapt: Callable[..., Any], whole: dict[str, bytes], tmp_path: Path) -> None:
    done = adapt("jobs.ply", "--block", "start", "--json")
    about = json.loads(done.out)
    assert done.code == 0 and about["blocks"] == BLOCKS and (about["pass"], about["missing"]) == (1, [1, 2, 3])
    for number in (3, 1):
        done = adapt("jobs.ply", "--block", number)
        assert done.code == 0 and (tmp_path / f"jobs.block{number}.pass1.safetensors").exists()
    assert "pass 1: blocks [2] are missing" in done.out and not (tmp_path / "jobs.ply").exists()
    done = adapt("jobs.ply", "--block", 1)
    assert done.code == 2 and "the second needs the first of all: run --block 2 first" in done.err
    assert adapt("jobs.ply", "--block", 2).code == 0
    done = adapt("jobs.ply", "--block", 2, "--json")
    assert json.loads(done.out)["missing"] == [1, 3] and (tmp_path / "jobs.block2.pass2.safetensors").exists()
    before = (tmp_path / "jobs.block2.pass2.safetensors").read_bytes()
    assert adapt("jobs.ply", "--block", 2).code == 0  # again: it is there
    assert (tmp_path / "jobs.block2.pass2.safetensors").read_bytes() == before
    done = adapt("jobs.ply")  # what is missing, and the whole
    assert done.code == 0 and "block 3 of 3, pass 2" in done.err
    assert "pass 1 of" not in done.err and "block 2 of" not in done.err
    assert outputs(tmp_path, "jobs") == whole
    assert not [path for path in tmp_path.iterdir() if "block" in path.name or "start" in path.name]


def test_a_killed_block_goes_on(
    adapt: Callable[..., Any], whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after its fifth step: the same command goes on from the state that was saved, and ends the same."""
    saving = resume.Saver.saving

    class Killed(BaseException):
        pass

    def dying(self: resume.Saver, listener: Any) -> Any:
        call = saving(self, listener)

        def step(progress: Progress) -> Any:
            self.due = 0.0
            going = call(progress)
            if progress.phase == Phase.TRAINING and progress.done == 5 and "block2.pass1" in str(self.path):
                raise Killed
            return going

        return step

    monkeypatch.setattr(resume.Saver, "saving", dying)
    with pytest.raises(Killed):
        adapt("again.ply")
    monkeypatch.setattr(resume.Saver, "saving", saving)
    left = sorted(path.name for path in tmp_path.iterdir() if path.name.startswith("again"))
    assert left == [
        "again.block1.pass1.safetensors", "again.block2.pass1.resume.safetensors", "again.start.safetensors"
    ]  # fmt: skip
    done = adapt("again.ply")
    assert done.code == 0 and "resuming again.block2.pass1.resume.safetensors from step 5" in done.err
    assert outputs(tmp_path, "again") == whole


def test_files_of_another_run_are_refused(adapt: Callable[..., Any], tmp_path: Path) -> None:
    assert adapt("a.ply", "--block", 1).code == 0
    done = adapt("a.ply", "--seed", 1)
    assert done.code == 2 and "a.start.safetensors: is of a run with another settings; remove it" in done.err
    (tmp_path / "a.block2.pass1.safetensors").write_bytes((tmp_path / "a.block1.pass1.safetensors").read_bytes())
    done = adapt("a.ply")
    assert done.code == 2 and "a.block2.pass1.safetensors: is of a run with another block" in done.err
    (tmp_path / "a.block1.pass1.safetensors").write_bytes(b"no block")
    done = adapt("a.ply")
    assert done.code == 2 and "a.block1.pass1.safetensors: is no block or damaged" in done.err
    (tmp_path / "a.block1.pass1.safetensors").unlink()
    (tmp_path / "a.start.safetensors").write_bytes((tmp_path / "a.start.safetensors").read_bytes()[:-9])
    assert "damaged" in adapt("a.ply").err and not (tmp_path / "a.ply").exists()


def test_what_cannot_be(clod: Callable[..., Any], capture: Any, adapt: Callable[..., Any], tmp_path: Path) -> None:
    given = [capture.ply, "--images", capture.scene]
    for words, message in (
        (["--memory", "8"], "--memory is '8'; give a number and its unit, as in 8GB"),
        (["--block", "2"], "--block needs --memory, which splits the scene in blocks; give both"),
        (["--memory", "8GB", "--block", "0"], "--block is '0'; give start, or the number of a block, from 1"),
        (["--memory", "8GB", "--block", "two"], "--block is 'two'; give start, or the number of a block, from 1"),
        (["--memory", "100MB"], "--memory is 100 MB, and 300 Gaussians take at least"),
    ):
        done = clod(*given, *words)
        assert done.code == 2 and message in done.err, done
    done = adapt("a.ply", "--block", 4)
    assert done.code == 2 and "--block is 4, and there are 3 blocks; give 1 to that" in done.err
    assert "the paper's form cannot be trained in blocks" in adapt("b.ply", "--form", "paper").err
    assert [path.name for path in tmp_path.iterdir()] == ["a.start.safetensors"]


def test_what_fits_is_as_without(clod: Callable[..., Any], capture: Any, tmp_path: Path) -> None:
    """The limit alone changes nothing, however few photographs stay in memory."""
    given = [capture.ply, "--images", capture.scene, "--iters", 6, "--max-sv", 3]
    for name, more in (("a", []), ("b", ["--memory", "8GB"])):
        done = clod(*given, "--out", f"{name}.ply", *more)
        assert done.code == 0
    assert "the whole scene at once" in done.err and "training" in done.err
    assert outputs(tmp_path, "a") == outputs(tmp_path, "b")


def test_another_limit_goes_on_with_no_other_blocks(
    adapt: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not with fewer, which would take more than the limit, and not without the work that is there."""
    assert adapt("a.ply", "--block", "start").code == 0
    for blocks in (1, BLOCKS + 1):
        monkeypatch.setattr(
            memory_option, "plan_for_limit", lambda *args, n=blocks: replace(plan_for_limit(*args), blocks=n)
        )
        done = adapt("a.ply")
        assert done.code == 2 and f"is of a run in 3 blocks, and --memory 8GB makes {blocks}; use" in done.err
    assert not (tmp_path / "a.ply").exists()


def test_what_fits_as_one_job(clod: Callable[..., Any], capture: Any, tmp_path: Path) -> None:
    """The work of the job is in the outputs, and its files are removed, whatever their name's letters mean."""
    given = [capture.ply, "--images", capture.scene, "--iters", 3, "--max-sv", 3, "--memory", "8GB", "--out", "[a].ply"]
    assert clod(*given, "--block", 1).code == 0
    done = clod(*given)
    assert (
        done.code == 0 and "block 1 of 1, pass" not in done.err and "the initialization of 1 blocks exists" in done.err
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["[a].json", "[a].ply", "[a].safetensors"]


def test_jobs_that_began_unlike(adapt: Callable[..., Any], tmp_path: Path) -> None:
    """Of machines that round unlike: what was learned of one division is put into no other."""
    assert adapt("a.ply", "--block", 1).code == 0
    path = tmp_path / "a.start.safetensors"
    from safetensors import safe_open

    from clod_adapter.blocks.file import KEY, save_block

    with safe_open(path, "pt") as file:
        belongs = json.loads(file.metadata()[KEY])["belongs"]
    tensors, about = load_block(path, belongs)
    save_block(path, tensors | {"block": tensors["block"].flip(0)}, about, belongs)
    done = adapt("a.ply")
    assert done.code == 2 and "a.block1.pass1.safetensors: is of a run with another start; remove it" in done.err


def test_a_start_that_was_tampered_with(adapt: Callable[..., Any], tmp_path: Path) -> None:
    assert adapt("a.ply", "--block", "start").code == 0
    path = tmp_path / "a.start.safetensors"
    from safetensors import safe_open

    from clod_adapter.blocks.file import KEY, save_block

    with safe_open(path, "pt") as file:
        found = json.loads(file.metadata()[KEY])
    tensors, about = load_block(path, found["belongs"])
    save_block(path, tensors, {"attenuation": about["attenuation"]}, found["belongs"])
    assert "damaged (KeyError('extent'))" in adapt("a.ply", "--block", 1).err
    for name, worse, message in (
        ("block", tensors["block"].clamp(max=1), "a block has no Gaussians"),
        ("sigma_d", tensors["sigma_d"][:-1], "its sigma_d is not that of this scene"),
        ("kept", tensors["kept"] * float("nan"), "not finite"),
    ):
        save_block(path, tensors | {name: worse}, about, found["belongs"])
        done = adapt("a.ply", "--block", 1)
        assert done.code == 2 and message in done.err, done
    assert memory.MOST_BLOCKS > BLOCKS


def test_opaque_gaussians_are_handed_on(clod: Callable[..., Any], capture: Any, forced: None, tmp_path: Path) -> None:
    """Opacity +inf, as files in the wild have it, is a value that a job's file may hold."""
    logits = capture.gaussians.opacity_logits.clone()
    logits[::7] = float("inf")
    ply = capture.write(tmp_path / "opaque.ply", capture.gaussians.replace(opacity_logits=logits))
    given = [ply, "--images", capture.scene, "--iters", 9, "--max-sv", 3, "--memory", "8GB", "--out", "a.ply"]
    assert clod(*given, "--block", 1).code == 0
    done = clod(*given)
    assert done.code == 0, done
    found = clod_adapter.load(tmp_path / "a.ply").gaussians.opacity_logits
    assert torch.equal(found.isinf(), logits.isinf()) and not found.isnan().any()


def test_a_block_whose_loss_is_not_finite_ends_early(
    adapt: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others do not, and all that was learned is written."""
    pull, pulls = Objective.gradient_sum, count(1)

    def spoilt(self: Objective, *given: Any) -> Any:
        found = pull(self, *given)  # not of the run that prepares the kernels
        return replace(found, loss=float("nan")) if self.config.max_sv == 3 and next(pulls) == 3 else found

    monkeypatch.setattr(Objective, "gradient_sum", spoilt)
    done = adapt("a.ply", "--json")
    report = json.loads(done.out)
    note = "block 1 of 3, pass 1 of 2: the loss of step 3 is not finite"
    assert done.code == 1 and any(note in each for each in report["notes"]) and len(report["rows"]) > 2, done
    assert "block 1 of 3, pass 1 of 2: ended after step 2: the loss of step 3" in done.err
    assert clod_adapter.load(tmp_path / "a.ply").gaussians.sigma_d is not None


def test_an_error_in_a_block_leaves_its_state(
    adapt: Callable[..., Any], whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pull, pulls = Objective.gradient_sum, count(1)

    def failing(self: Objective, *given: Any) -> Any:
        if self.config.max_sv == 3 and next(pulls) == 6:
            raise ZeroDivisionError
        return pull(self, *given)

    monkeypatch.setattr(Objective, "gradient_sum", failing)
    done = adapt("a.ply", "--quiet")
    state = "a.block1.pass1.resume.safetensors"
    assert done.code == 1 and f"the same command resumes from step 5, which is in {state}\n" in done.err, done
    done = adapt("a.ply")
    assert done.code == 0 and f"resuming {state} from step 5" in done.err and outputs(tmp_path, "a") == whole


def test_ctrl_c_leaves_what_is_finished(
    adapt: Callable[..., Any], whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = follower.ProgressDisplay.__call__

    def pressed(self: follower.ProgressDisplay, progress: Progress) -> bool:
        if progress.phase == Phase.TRAINING and progress.done == 3 and "block 2 of 3, pass 1" in self.training:
            self.stop.requests += 1
        return call(self, progress)

    monkeypatch.setattr(follower.ProgressDisplay, "__call__", pressed)
    done = adapt("a.ply")
    assert done.code == 130 and "pass 1 of 2: stopped after step 3; the same command resumes it" in done.err
    assert (tmp_path / "a.block1.pass1.safetensors").exists() and not (tmp_path / "a.ply").exists()
    monkeypatch.setattr(follower.ProgressDisplay, "__call__", call)
    assert adapt("a.ply").code == 0 and outputs(tmp_path, "a") == whole
