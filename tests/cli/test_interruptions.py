"""Kills, Ctrl-C and SIGTERM: inputs are unchanged, outputs are complete or absent, --resume gives the same files."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
import time
from itertools import count
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli.adapt import inputs as adapt_inputs
from clod_adapter.cli.adapt import saver
from clod_adapter.cli.shared import measure
from clod_adapter.progress import Phase, tell
from clod_adapter.training import planner
from clod_adapter.training.state_file import load_state
from runs import OUTPUTS, STATE, Server, log_of, names, pressing, wait_for
from scenes import stripped

ITERS, KILLS = 24, 20


@pytest.fixture(scope="module")
def words(capture: Any) -> list[Any]:
    return [capture.ply, "--images", capture.scene, "--iters", ITERS, "--max-sv", 4, "--out", "dial.ply"]


@pytest.fixture(scope="module")
def undisturbed(server: Server, words: list[Any], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """The folder of an uninterrupted run, and its wall time in seconds."""
    folder, began = tmp_path_factory.mktemp("undisturbed"), time.perf_counter()
    code, log = server.run(folder, *words)
    assert code == 0, log
    return folder, time.perf_counter() - began


def fingerprints(*roots: Path) -> dict[Path, str]:
    files = [file for root in roots for file in ([root] if root.is_file() else root.rglob("*")) if file.is_file()]
    return {file: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def assert_whole(folder: Path) -> None:
    """Outputs can be read, and all other files have the name of a temporary file."""
    for name in names(folder):
        path = folder / name
        if name == STATE:
            load_state(path)
        elif path.suffix == ".ply" and not name.startswith(".tmp-"):
            assert clod_adapter.load(path).gaussians.sigma_d is not None
        elif path.suffix == ".safetensors" and not name.startswith(".tmp-"):
            clod_adapter.load_adapter(path)
        elif name == "dial.json":
            json.loads(path.read_text())
        else:
            assert name.startswith(".tmp-"), name


def assert_same(folder: Path, want: Path) -> None:
    """The same bits, except measured times, and no other files."""
    assert names(folder) == OUTPUTS, log_of(folder)
    for name in OUTPUTS[1:]:
        assert stripped((folder / name).read_bytes()) == stripped((want / name).read_bytes()), name
    found, wanted = (json.loads((path / "dial.json").read_text()) for path in (folder, want))
    assert [row["psnr"] for row in found["rows"]] == [row["psnr"] for row in wanted["rows"]]
    assert found["steps"] == ITERS and not found["interrupted"]


@pytest.mark.timeout(300)
def test_kills_at_random_moments(
    server: Server, words: list[Any], capture: Any, undisturbed: tuple[Path, float], tmp_path: Path
) -> None:
    """Each run is killed and resumed until it ends before its kill; every second chain replaces earlier files.

    Every second kill comes after a state was saved, however fast the machine is.
    """
    want, seconds = undisturbed
    before, draw, kills, resumed = fingerprints(capture.ply, capture.scene), random.Random(7), 0, set()
    for chain in count():
        if kills == KILLS:
            break
        folder = tmp_path / f"chain{chain}"
        shutil.copytree(want, folder) if chain % 2 else folder.mkdir()
        code = -signal.SIGKILL
        while code != 0:
            child = server.start(folder, *words, "--resume")
            if kills < KILLS:
                while kills % 2 and not (folder / STATE).exists() and not server.ask(ended=child):
                    time.sleep(0.002)
                began, after = time.monotonic(), draw.uniform(0, seconds / 8 if kills % 2 else seconds)
                while (lived := time.monotonic() - began) < after and not server.ask(ended=child):
                    time.sleep(0.002)
                if (
                    server.ask(ended=child) and kills % 2 == 0
                ):  # the machine is faster than it was when the run was timed
                    seconds = (seconds + lived) / 2
                os.kill(child, signal.SIGKILL)
            code = server.wait(child)
            assert code in (0, -signal.SIGKILL), log_of(folder)
            kills += code != 0
            assert_whole(folder)
            assert fingerprints(capture.ply, capture.scene) == before
        assert_same(folder, want)
        resumed.add(json.loads((folder / "dial.json").read_text())["resumed_from"])
    assert resumed - {None}, "no kill came while there was a state"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_interrupt_of_training_writes_the_result_so_far(
    server: Server, words: list[Any], undisturbed: tuple[Path, float], tmp_path: Path, clod: Any, number: int
) -> None:
    """The state is written too, and the log has only the command's lines."""
    child = server.start(tmp_path, *words)
    wait_for(tmp_path / STATE)
    os.kill(child, number)
    code, log = server.wait(child), log_of(tmp_path)
    report = json.loads((tmp_path / "dial.json").read_text())
    assert code == 0 and report["interrupted"] and report["resumed_from"] is None and "interrupted after" in log, log
    assert names(tmp_path) == sorted([*OUTPUTS, STATE]) and load_state(tmp_path / STATE)[0].steps == report["steps"]
    assert f"--resume resumes from step {report['steps']}, which is in {STATE}" in log and "SIGTERM" not in log
    assert_whole(tmp_path)
    assert clod("apply", words[0], "dial.safetensors", "-o", tmp_path.with_suffix(".ply")).code == 0
    assert tmp_path.with_suffix(".ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    code, log = server.run(tmp_path, *words, "--resume")
    assert code == 0 and f"resuming {STATE} from step {report['steps']}" in log, log
    assert_same(tmp_path, undisturbed[0])
    assert json.loads((tmp_path / "dial.json").read_text())["resumed_from"] == report["steps"]


def test_two_interrupts_abort(server: Server, words: list[Any], undisturbed: Any, tmp_path: Path) -> None:
    child = server.start(tmp_path, *words)
    wait_for(tmp_path / STATE)
    os.kill(child, signal.SIGINT)
    os.kill(child, signal.SIGTERM)  # two equal signals could arrive as one
    assert server.wait(child) == 130 and names(tmp_path) == [STATE], log_of(tmp_path)
    assert server.run(tmp_path, *words, "--resume")[0] == 0
    assert_same(tmp_path, undisturbed[0])


def test_second_interrupt_aborts_the_measurement_too(
    clod: Any, words: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the message after the first one says; a message names the saved step."""
    monkeypatch.setattr(saver, "save_state", pressing(saver.save_state, signal.SIGINT))
    monkeypatch.setattr(measure, "evaluate", pressing(measure.evaluate, signal.SIGINT, at=2))  # the first: the base
    done = clod(*words)
    assert done.code == 130 and names(tmp_path) == [STATE] and "Ctrl-C again aborts without writing" in done.err, done
    step = load_state(tmp_path / STATE)[0].steps
    assert f"--resume resumes from step {step}, which is in {STATE}\nclod-adapt: interrupted" in done.err, done


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ignored_interrupt_stays_ignored(
    clod: Any, words: list[Any], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """As in a background job of a script; SIGTERM still ends it."""
    monkeypatch.setattr(saver, "save_state", pressing(saver.save_state, number))
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        done = clod(*words, "--json")
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    assert done.code == 0 and json.loads(done.out)["interrupted"] == (number == signal.SIGTERM), done


@pytest.mark.parametrize(
    ("where", "numbers"),
    [("kernels", [signal.SIGTERM]), ("plan", [signal.SIGINT]), ("training", [signal.SIGINT]),
     ("training", [signal.SIGINT, signal.SIGINT])],
)  # fmt: skip
def test_interrupts_before_the_first_step_write_nothing(
    clod: Any, words: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, numbers: list[int]
) -> None:
    def adapt(base: Any, scene: Any, config: Any, progress: Any, resume: Any, **rest: Any) -> Any:
        pressing(tell, *numbers)(progress, Phase.IMPORTANCE, 1, 8)
        pytest.fail("continued")

    monkeypatch.setattr("clod_adapter.training.plan.adapt", adapt)
    if where == "kernels":
        monkeypatch.setattr(adapt_inputs, "prepare_kernels", pressing(adapt_inputs.prepare_kernels, *numbers))
    if where == "plan":
        monkeypatch.setattr(planner, "sh_degree_losses", pressing(planner.sh_degree_losses, *numbers))
    done = clod(*words)
    assert ("plan:" in done.err) == (where == "training"), done
    assert done.code == 130 and done.err.splitlines()[-1] == "clod-adapt: interrupted" and names(tmp_path) == []
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_second_run_with_the_same_output_is_refused(
    server: Server, words: list[Any], undisturbed: tuple[Path, float], tmp_path: Path, clod: Any
) -> None:
    """While the first process exists, also suspended; its result does not change."""
    child = server.start(tmp_path, *words)
    wait_for(tmp_path / STATE)
    os.kill(child, signal.SIGSTOP)
    before = fingerprints(tmp_path / STATE)
    for more in ((), ("--resume",)):
        done = clod(*words, *more)
        assert done.code == 2 and f"dial.ply: another run (process {child}) is writing it; wait" in done.err, done
    assert fingerprints(tmp_path / STATE) == before
    os.kill(child, signal.SIGCONT)
    assert server.wait(child) == 0, log_of(tmp_path)
    assert_same(tmp_path, undisturbed[0])
