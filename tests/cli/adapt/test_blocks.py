"""``--memory`` and ``--block``: one process and separate jobs write the same files, also after a kill."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open

import clod_adapter
from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.blocks import memory
from clod_adapter.blocks.file import KEY, load_block, save_block
from clod_adapter.blocks.memory import MemoryPlan, plan_for_limit
from clod_adapter.cli.adapt import memory as memory_option
from clod_adapter.cli.adapt import saver
from clod_adapter.cli.adapt.display import ProgressDisplay
from clod_adapter.io.adapter_file import load_adapter
from clod_adapter.progress import Phase, Progress
from runs import change_step, fail, names
from scenes import stripped

BLOCKS = 3
KINDS = ("json", "ply", "safetensors")


@pytest.fixture
def forced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trains in blocks, although the scene fits in memory."""

    def plan(*args: Any) -> MemoryPlan:
        return replace(plan_for_limit(*args), blocks=BLOCKS)

    monkeypatch.setattr(memory_option, "plan_for_limit", plan)


@pytest.fixture
def adapt(clod: Callable[..., Any], capture: Any, forced: None) -> Callable[..., Any]:
    """Adapts in blocks."""

    def run(out: str, *more: object) -> Any:
        given = ["--images", capture.scene, "--iters", 9, "--max-sv", 3, "--memory", "8GB", "--out", out]
        return clod(capture.ply, *given, *more)

    return run


@pytest.fixture(scope="module")
def kept() -> dict[str, bytes]:
    return {}


@pytest.fixture
def whole(adapt: Callable[..., Any], tmp_path: Path, kept: dict[str, bytes]) -> dict[str, bytes]:
    """The files that one process writes; it runs once."""
    if kept:
        return kept
    (tmp_path / "one.blocks.safetensors").write_bytes(b"the user's")
    done = adapt("one.ply", "--json")
    assert done.code == 0, done
    report = json.loads(done.out)
    assert report["memory"]["blocks"] == BLOCKS and report["steps"] == 27 and len(report["rows"]) > 2
    left_out = next(each for each in report["plan"]["decisions"] if each["name"] == "unseen")["number"]
    trained = (300 - int(left_out)) // BLOCKS
    assert 0 < left_out < 100 and f"of 3, pass 1 of 2: {trained} Gaussians, 7 steps" in done.err
    assert "in 3 blocks" in done.err and "unseen Gaussians" in done.err
    assert report["seconds"]["start"] > 0
    assert names(tmp_path) == ["one.blocks.safetensors", "one.json", "one.ply", "one.safetensors"]
    (tmp_path / "one.blocks.safetensors").unlink()
    kept.update(outputs(tmp_path, "one"))
    return kept


def outputs(folder: Path, name: str) -> dict[str, bytes]:
    return {suffix: stripped((folder / f"{name}{suffix}").read_bytes()) for suffix in (".ply", ".safetensors")}


def test_jobs_write_the_files_of_one_process(
    adapt: Callable[..., Any], whole: dict[str, bytes], tmp_path: Path
) -> None:
    done = adapt("jobs.ply", "--block", "start", "--json")
    about = json.loads(done.out)
    assert done.code == 0 and about["blocks"] == BLOCKS and (about["pass"], about["missing"]) == (1, [1, 2, 3])
    assert "unseen Gaussians" in done.err
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
    assert adapt("jobs.ply", "--block", 2).code == 0  # its file exists
    assert (tmp_path / "jobs.block2.pass2.safetensors").read_bytes() == before
    done = adapt("jobs.ply")  # trains the missing blocks, and merges
    assert done.code == 0 and "block 3 of 3, pass 2" in done.err
    assert "pass 1 of" not in done.err and "block 2 of" not in done.err
    assert outputs(tmp_path, "jobs") == whole
    assert not [path for path in tmp_path.iterdir() if "block" in path.name or "start" in path.name]


class Killed(BaseException):
    """Ends a run, and the run does not handle it."""


def kill(patch: pytest.MonkeyPatch) -> None:
    saving = saver.Saver.saving

    def dying(self: saver.Saver, listener: Any) -> Any:
        call = saving(self, listener)

        def step(progress: Progress) -> Any:
            self.due = 0.0
            going = call(progress)
            if progress.phase == Phase.TRAINING and progress.done == 5 and "block2.pass1" in str(self.path):
                raise Killed
            return going

        return step

    patch.setattr(saver.Saver, "saving", dying)


def interrupt(patch: pytest.MonkeyPatch) -> None:
    call = ProgressDisplay.__call__

    def pressed(self: ProgressDisplay, progress: Progress) -> bool:
        if progress.phase == Phase.TRAINING and progress.done == 3 and "block 2 of 3, pass 1" in self.training:
            self.stop.requests += 1
        return call(self, progress)

    patch.setattr(ProgressDisplay, "__call__", pressed)


@pytest.mark.parametrize(
    ("ended", "code", "said", "state", "steps"),
    [
        (kill, None, "", "a.block2.pass1.resume.safetensors", 5),
        (interrupt, 130, "pass 1 of 2: stopped after step 3; the same command", "a.block2.pass1.resume.safetensors", 3),
        (lambda patch: change_step(patch, 6, fail), 1, "the same command resumes from step 5, which is in "
         "a.block1.pass1.resume.safetensors\n", "a.block1.pass1.resume.safetensors", 5),
    ],
    ids=["killed", "ctrl-c", "error"],
)  # fmt: skip
def test_same_command_resumes_an_interrupted_block(
    adapt: Any, whole: dict[str, bytes], tmp_path: Path, ended: Any, code: Any, said: str, state: str, steps: int
) -> None:
    """Finished blocks are kept, the interrupted one is resumed, and the files are the same."""
    with pytest.MonkeyPatch.context() as patch:
        ended(patch)
        if code is None:
            with pytest.raises(Killed):
                adapt("a.ply")
        else:
            done = adapt("a.ply", *(["--quiet"] if code == 1 else []))
            assert done.code == code and said in done.err, done
    finished = ["a.block1.pass1.safetensors"] if "block2" in state else []
    assert names(tmp_path) == sorted([*finished, state, "a.start.safetensors"])
    done = adapt("a.ply")
    assert done.code == 0 and f"resuming {state} from step {steps}" in done.err and outputs(tmp_path, "a") == whole


def test_files_of_another_run_are_refused(
    adapt: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other settings, number of blocks, block or initialization, and damaged files."""

    def refused(message: str, *more: object) -> None:
        done = adapt("a.ply", *more)
        assert done.code == 2 and message in done.err and not (tmp_path / "a.ply").exists(), done

    start, first, second = (tmp_path / f"a.{name}.safetensors" for name in ("start", "block1.pass1", "block2.pass1"))
    assert adapt("a.ply", "--block", 1).code == 0
    refused("a.start.safetensors: is of a run with another settings; remove it", "--seed", 1)
    refused("a.start.safetensors: is of a run with another --with or --without; remove it", "--with", "unseen")
    for blocks in (1, BLOCKS + 1):  # fewer would take more than the limit
        with monkeypatch.context() as patch:
            patch.setattr(memory_option, "plan_for_limit", lambda *a, n=blocks: replace(plan_for_limit(*a), blocks=n))
            refused(f"is of a run in 3 blocks, and --memory 8GB makes {blocks}; use")
    shutil.copy(first, second)
    refused("a.block2.pass1.safetensors: is of a run with another block")
    second.unlink()
    with safe_open(start, "pt") as file:
        belongs = json.loads(file.metadata()[KEY])["belongs"]
    tensors, about = load_block(start, belongs)
    save_block(start, tensors | {"block": tensors["block"].flip(0)}, about, belongs)  # as other rounding would
    refused("a.block1.pass1.safetensors: is of a run with another start; remove it")
    first.write_bytes(first.read_bytes()[:-9])
    refused("a.block1.pass1.safetensors: is no block or damaged")
    first.unlink()
    save_block(start, tensors, {"attenuation": about["attenuation"]}, belongs)
    refused("damaged (KeyError('config'))", "--block", 1)
    for name, worse, message in (
        ("block", tensors["block"].clamp(max=1), "a block has no Gaussians"),
        ("kept", tensors["kept"].float(), "its kept is not that of this scene"),
        ("kept", ~tensors["kept"], "its block is not that of this scene"),
        ("sigma_d", tensors["sigma_d"][:-1], "its sigma_d is not that of this scene"),
        ("growth_d", tensors["growth_d"].double(), "its growth_d is not that of this scene"),
        ("seen", tensors["seen"] * float("nan"), "not finite"),
    ):
        save_block(start, tensors | {name: worse}, about, belongs)
        refused(message, "--block", 1)
    save_block(start, {name: tensor for name, tensor in tensors.items() if name != "growth_d"}, about, belongs)
    refused("its growth_d is not that of this scene", "--block", 1)
    start.write_bytes(start.read_bytes()[:-9])
    refused("damaged")
    assert memory.MOST_BLOCKS > BLOCKS


def test_blocks_follow_the_plan_of_the_whole(
    clod: Callable[..., Any], adapt: Callable[..., Any], capture: Any, tmp_path: Path
) -> None:
    """The same decisions; with --trim what is left out is not written, else it is the base's; frozen is not tuned."""
    frozen = ["--without", "means", "--json"]
    given = ["--images", capture.scene, "--iters", 9, "--max-sv", 3, "--out", "a.ply"]
    runs = [clod(capture.ply, *given, *frozen), adapt("b.ply", *frozen), adapt("c.ply", *frozen, "--trim")]
    plans = [json.loads(done.out)["plan"]["decisions"] for done in runs]
    assert plans[1] == plans[0] and any((each["what"], each["verdict"]) == ("means", "frozen") for each in plans[0])
    assert plans[2][:-1] == plans[1] and plans[2][-1]["verdict"] == "trimmed"
    whole, few = (clod_adapter.load(tmp_path / f"{name}.ply").gaussians for name in "bc")
    base, adapter = clod_adapter.load(capture.ply).gaussians, load_adapter(tmp_path / "c.safetensors")
    assert adapter.kept is not None and len(few) == int(adapter.kept.sum()) < len(whole) == len(base)
    assert torch.equal(whole.means, base.means) and torch.equal(whole.sh0[~adapter.kept], base.sh0[~adapter.kept])
    assert all(torch.equal(getattr(few, name), getattr(whole, name)[adapter.kept]) for name in ATTRIBUTES[:5])


def test_blocks_without_growth(adapt: Callable[..., Any], tmp_path: Path) -> None:
    assert adapt("a.ply", "--block", "start", "--growth", "off").code == 0
    with safe_open(tmp_path / "a.start.safetensors", "pt") as file:
        assert set(file.keys()) == {"sigma_d", "kept", "block", "seen"}
    assert adapt("a.ply", "--growth", "off").code == 0
    assert set(clod_adapter.load(tmp_path / "a.ply").gaussians.tensors()) == {*ATTRIBUTES, "sigma_d"}


def test_unusable_options(clod: Callable[..., Any], capture: Any, adapt: Callable[..., Any], tmp_path: Path) -> None:
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
    assert done.code == 2 and "--block is 4, and the number of blocks is 3; give a number from 1 to 3" in done.err
    assert "the paper's form cannot be trained in blocks" in adapt("b.ply", "--form", "paper").err
    assert not list(tmp_path.iterdir())


def test_sufficient_memory_changes_nothing(clod: Callable[..., Any], capture: Any, tmp_path: Path) -> None:
    """Also with a job, whose files are removed after the merge."""
    given = [capture.ply, "--images", capture.scene, "--iters", 6, "--max-sv", 3, "--out"]
    assert clod(*given, "a.ply").code == 0
    done = clod(*given, "b.ply", "--memory", "8GB")
    assert done.code == 0 and "the whole scene at once" in done.err and "training" in done.err
    assert clod(*given, "[c].ply", "--memory", "8GB", "--block", 1).code == 0
    done = clod(*given, "[c].ply", "--memory", "8GB")
    assert done.code == 0 and "block 1 of 1, pass" not in done.err
    assert "the initialization of 1 blocks exists" in done.err
    assert names(tmp_path) == sorted(f"{name}.{kind}" for name in ("[c]", "a", "b") for kind in KINDS)
    assert outputs(tmp_path, "a") == outputs(tmp_path, "b")


def test_block_files_hold_infinite_opacities(
    clod: Callable[..., Any], capture: Any, forced: None, tmp_path: Path
) -> None:
    logits = capture.gaussians.opacity_logits.clone()
    logits[::7] = float("inf")
    ply = capture.write(tmp_path / "opaque.ply", capture.gaussians.replace(opacity_logits=logits))
    given = [ply, "--images", capture.scene, "--iters", 9, "--max-sv", 3, "--memory", "8GB", "--out", "a.ply"]
    assert clod(*given, "--block", 1).code == 0
    done = clod(*given)
    assert done.code == 0, done
    found = clod_adapter.load(tmp_path / "a.ply").gaussians.opacity_logits
    assert torch.equal(found.isinf(), logits.isinf()) and not found.isnan().any()


def test_non_finite_gradients_of_a_job_are_reported_by_the_merge(
    adapt: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(found: Any) -> Any:
        found.gradients["quats"][5] = float("nan")
        return found

    with monkeypatch.context() as patch:
        change_step(patch, 3, spoil)
        assert adapt("a.ply", "--block", 1).code == 0
    assert "1 Gaussians were not moved by some steps" in adapt("a.ply").err


def test_non_finite_loss_of_a_job_is_reported_by_the_merge(
    adapt: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That block ends early, and the exit code is 1, as without blocks; all that was learned is written."""
    with monkeypatch.context() as patch:
        change_step(patch, 3, lambda found: replace(found, loss=float("nan")))
        done = adapt("a.ply", "--block", 1)
    assert done.code == 1 and "block 1 of 3, pass 1 of 2: ended after step 2: the loss of step 3" in done.err, done
    done = adapt("a.ply", "--json")
    report = json.loads(done.out)
    note = "block 1 of 3, pass 1 of 2: the loss of step 3 is not finite"
    assert done.code == 1 and any(note in each for each in report["notes"]) and len(report["rows"]) > 2, done
    assert clod_adapter.load(tmp_path / "a.ply").gaussians.sigma_d is not None
