"""``--memory``: a scene in blocks is trained in one process, also after a kill, an interrupt or an error."""

import signal
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.blocks.memory import MemoryPlan, plan_for_limit
from clod_adapter.cli.adapt import prepare
from runs import change_step, fail, names, results

BLOCKS = 3
TINY = "--images SCENE --iters 9 --max-sv 3 --antialiasing off"


def in_blocks(*args: Any) -> MemoryPlan:
    """Blocks, although the scene fits in memory."""
    return replace(plan_for_limit(*args), blocks=BLOCKS)


@pytest.fixture(scope="module")
def opaque(capture: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint with some infinite opacities, as files in the wild have."""
    logits = capture.gaussians.opacity_logits.clone()
    logits[::7] = float("inf")
    path = tmp_path_factory.mktemp("opaque") / "opaque.ply"
    return Path(capture.write(path, capture.gaussians.replace(opacity_logits=logits)))


@pytest.fixture
def adapt(clod: Callable[..., Any], opaque: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Adapts in blocks."""
    monkeypatch.setattr(prepare, "plan_for_limit", in_blocks)
    return partial(clod, opaque, TINY, "--memory 8GB --out")


@pytest.fixture(scope="module")
def whole(opaque: Path, run_in: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prepare, "plan_for_limit", in_blocks)
        done = run_in(folder, opaque, TINY, "--memory 8GB --out one.ply --json")
    report = done.report
    assert report["memory"]["blocks"] == BLOCKS and report["steps"] == 26 and len(report["rows"]) > 2
    left_out = next(each for each in report["plan"]["decisions"] if each["name"] == "unseen")["number"]
    trained = (300 - int(left_out)) // BLOCKS
    assert 0 < left_out < 100 and f"of 3, pass 1 of 2: {trained} Gaussians, 7 steps" in done.err
    assert "in 3 blocks" in done.err and "unseen Gaussians" in done.err and report["seconds"]["start"] > 0
    logits = clod_adapter.load(folder / "one.ply").gaussians.opacity_logits
    assert torch.equal(logits.isinf(), torch.arange(300) % 7 == 0) and not logits.isnan().any()
    assert names(folder) == ["one.json", "one.ply", "one.safetensors"]
    return results(folder, "one")


def press(found: Any) -> Any:
    signal.raise_signal(signal.SIGINT)
    return found


@pytest.mark.parametrize(
    ("at", "change", "said", "block", "steps"),
    [
        (10, press, "pass 1 of 2: stopped after step 3; the same command", "block2", 3),
        (6, fail, "the same command resumes from step 5, which is in a.block1.pass1.resume.safetensors", "block1", 5),
    ],
)
def test_same_command_resumes_an_interrupted_block(
    adapt: Any, whole: dict[str, bytes], tmp_path: Path, at: int, change: Any, said: str, block: str, steps: int
) -> None:
    """And keeps finished blocks, with the same files. Files of another run or block, or damaged ones, are refused."""
    with pytest.MonkeyPatch.context() as patch:
        change_step(patch, at, change)
        done = adapt("a.ply --quiet", code=1) if change is fail else adapt("a.ply", code=130)
    state, finished = f"a.{block}.pass1.resume.safetensors", ["a.block1.pass1.safetensors"] if block == "block2" else []
    assert said in done.err and names(tmp_path) == sorted([*finished, state]), done
    for name in finished:
        content, other = Path(name).read_bytes(), "a.block2.pass1.safetensors"
        for file, data, more, message in (
            (name, content, "--seed 1", "is of a run with another config; remove it, or give --out"),
            (name, content, "--with unseen", "is of a run with another config; remove it"),
            (other, content, "", "is of a run with another block"),
            (name, content[:-9], "", "is no block or is dam"),
        ):
            Path(file).write_bytes(data)
            assert f"{file}: {message}" in adapt("a.ply", more, code=2).err
            Path(other).unlink(missing_ok=True)
        Path(name).write_bytes(content)
    done = adapt("a.ply")
    assert f"resuming {state} from step {steps}" in done.err, done
    assert ("block 1 of 3, pass 1" in done.err) == (block == "block1")
    assert results(tmp_path, "a") == whole and names(tmp_path) == ["a.json", "a.ply", "a.safetensors"]


def test_blocks_follow_the_plan_of_the_whole(clod: Any, adapt: Any, opaque: Path) -> None:
    """But for far Gaussians; with --trim what is left out is not written; what is frozen is not tuned."""
    frozen = "--without means --growth off --json"
    runs = (clod(opaque, TINY, "--out a.ply", frozen), adapt("c.ply", frozen, "--trim"))
    plans = [done.report["plan"]["decisions"] for done in runs]
    assert any((each["what"], each["verdict"]) == ("means", "frozen") for each in plans[0])
    assert plans[1][0]["what"] == plans[0][0]["what"] and plans[1][-1]["verdict"] == "trimmed"
    assert [any(each["what"] == "far Gaussians" for each in plan) for plan in plans] == [True, False]
    base, few = (clod_adapter.load(path).gaussians for path in (opaque, "c.ply"))
    kept = clod_adapter.load_adapter("c.safetensors").kept
    assert set(few.tensors()) == {*ATTRIBUTES, "sigma_d"}
    assert kept is not None and len(few) == int(kept.sum()) < len(base) and torch.equal(few.means, base.means[kept])


def test_blocks_that_fail_or_are_held_are_reported(adapt: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A block whose loss is not finite ends early; all that was learned is written, with exit code 1."""

    def spoil(found: Any) -> Any:
        found.gradients["quats"][5] = float("nan")
        return found

    change_step(monkeypatch, 2, spoil)
    change_step(monkeypatch, 3, lambda found: replace(found, loss=float("nan")))
    report = (done := adapt("a.ply --json", code=1)).report
    note = "block 1 of 3, pass 1 of 2: the loss of step 3 is not finite"
    assert any(note in each for each in report["notes"]) and len(report["rows"]) > 2, done
    assert "block 1 of 3, pass 1 of 2: ended after step 2: the loss of step 3" in done.err
    assert "1 Gaussians were not moved by some steps" in done.err
    assert clod_adapter.load("a.ply").gaussians.sigma_d is not None


def test_sufficient_memory_changes_nothing(clod: Any, opaque: Path, tmp_path: Path) -> None:
    """Files of an earlier run in blocks are removed with the result."""
    clod(opaque, TINY, "--out a.ply")
    (tmp_path / "[b].block1.pass1.safetensors").write_bytes((tmp_path / "a.safetensors").read_bytes())
    done = clod(opaque, TINY, "--memory 8GB --out [b].ply")
    assert "the whole scene at once" in done.err and "training" in done.err
    assert names(tmp_path) == [f"{name}.{kind}" for name in ("[b]", "a") for kind in ("json", "ply", "safetensors")]
    assert results(tmp_path, "a") == results(tmp_path, "[b]")
