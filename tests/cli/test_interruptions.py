"""Kills, Ctrl-C, SIGTERM and full disks: inputs are unharmed, outputs are whole or absent, --resume ends the same."""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import clod_adapter
from clod_adapter._support.version import package_version
from clod_adapter.cli.adapt import inputs as adapt_inputs
from clod_adapter.cli.adapt import resume
from clod_adapter.cli.adapt import run as adapt_command
from clod_adapter.cli.shared import inputs
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.interrupts import GracefulStop
from clod_adapter.errors import ClodError
from clod_adapter.progress import Phase, Progress
from clod_adapter.training.state_file import load_state
from scenes import stripped

OUTPUTS = ["dial.json", "dial.ply", "dial.safetensors"]
STATE = "dial.resume.safetensors"
ITERS, KILLS = 24, 20

# Imports everything once; a line on stdin is a command, run in a process of its own, or asks for the last one's end.
SERVER = """
import json, os, signal, sys, tempfile
import torch
torch.set_num_threads(1)  # a process that forks must have no threads
from clod_adapter.cli import main
from clod_adapter.cli.adapt import resume
from clod_adapter.cli.adapt import run as adapt
from clod_adapter.cli.shared import console
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.kernels import prepare_kernels
prepare_kernels(Console(quiet=True))
print("ready", flush=True)
for line in sys.stdin:
    if line == "ended\\n":
        print(int(os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None), flush=True)
        continue
    if line == "wait\\n":
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
        continue
    words, folder = json.loads(line)
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        tempfile.tempdir = os.path.dirname(folder)
        log = os.open(f"{folder}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(log, stream)
        torch.set_num_threads(2)
        resume.SAVE_EVERY, resume.SAVE_COST = 0.0, 1e9  # so that kills find states of many ages
        code = main.main(words)
        sys.stdout.flush()
        os._exit(code)
    print(child, flush=True)
"""


class Server:
    """Runs ``clod-adapt`` in real processes that need no seconds to start."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", SERVER], text=True, bufsize=1, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._line() == "ready"

    def start(self, folder: Path, *words: object) -> int:
        """The process's id, which is its own until it is waited for; its output goes to a file beside the folder."""
        return int(self._ask(json.dumps([list(map(str, words)), str(folder)])))

    def wait(self) -> int:
        """The exit code; of a killed one the signal, negative."""
        return int(self._ask("wait"))

    def ended(self) -> bool:
        return self._ask("ended") == "1"

    def run(self, folder: Path, *words: object) -> tuple[int, str]:
        """Exit code and output."""
        self.start(folder, *words)
        return self.wait(), log_of(folder)

    def _ask(self, line: str) -> str:
        self.process.stdin.write(f"{line}\n")
        return self._line()

    def _line(self) -> str:
        return self.process.stdout.readline().strip()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.process.kill()
    server.process.communicate()


@pytest.fixture(scope="module")
def words(capture: Any) -> list[Any]:
    return [capture.ply, "--images", capture.scene, "--iters", ITERS, "--max-sv", 4, "--out", "dial.ply"]


@pytest.fixture(scope="module")
def undisturbed(server: Server, words: list[Any], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """The folder of a run that nothing happens to, and the seconds that it took."""
    folder, began = tmp_path_factory.mktemp("undisturbed"), time.perf_counter()
    code, log = server.run(folder, *words)
    assert code == 0, log
    return folder, time.perf_counter() - began


def fingerprints(*roots: Path) -> dict[Path, str]:
    files = [file for root in roots for file in ([root] if root.is_file() else root.rglob("*")) if file.is_file()]
    return {file: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def log_of(folder: Path) -> str:
    return Path(f"{folder}.log").read_text()


def assert_whole(folder: Path) -> None:
    """What carries a final name can be read, and anything else by its name is unfinished."""
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
    """Bit for bit, but for measured times; and nothing else is left."""
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
    """Each run is killed and resumed until it ends before its kill; every second begins beside earlier files."""
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
                began, after = time.monotonic(), draw.uniform(0, seconds)
                while (lived := time.monotonic() - began) < after and not server.ended():
                    time.sleep(0.002)
                if server.ended():  # the machine is faster than it was when the run was timed
                    seconds = (seconds + lived) / 2
                os.kill(child, signal.SIGKILL)
            code = server.wait()
            assert code in (0, -signal.SIGKILL), log_of(folder)
            kills += code != 0
            assert_whole(folder)
            assert fingerprints(capture.ply, capture.scene) == before
        assert_same(folder, want)
        resumed.add(json.loads((folder / "dial.json").read_text())["resumed_from"])
    assert resumed - {None}, "no kill came while there was a state"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_interrupt_while_training(
    server: Server, words: list[Any], undisturbed: tuple[Path, float], tmp_path: Path, number: int
) -> None:
    """It writes what there is, and the state; and the log has nothing but our own lines."""
    child = server.start(tmp_path, *words)
    wait_for(tmp_path / STATE, child)
    os.kill(child, number)
    code, log = server.wait(), log_of(tmp_path)
    report = json.loads((tmp_path / "dial.json").read_text())
    assert code == 0 and report["interrupted"] and report["resumed_from"] is None, log
    assert names(tmp_path) == sorted([*OUTPUTS, STATE]) and load_state(tmp_path / STATE)[0].steps == report["steps"]
    assert f"--resume resumes from step {report['steps']}, which is in {STATE}" in log and "SIGTERM" not in log
    assert_whole(tmp_path)
    code, log = server.run(tmp_path, *words, "--resume")
    assert code == 0 and f"resuming {STATE} from step {report['steps']}" in log, log
    assert_same(tmp_path, undisturbed[0])
    assert json.loads((tmp_path / "dial.json").read_text())["resumed_from"] == report["steps"]


def test_two_interrupts_abort(
    server: Server, words: list[Any], undisturbed: tuple[Path, float], tmp_path: Path
) -> None:
    child = server.start(tmp_path, *words)
    wait_for(tmp_path / STATE, child)
    os.kill(child, signal.SIGINT)
    os.kill(child, signal.SIGTERM)  # not twice the same, which could arrive as one
    code = server.wait()
    assert code == 130 and names(tmp_path) == [STATE], log_of(tmp_path)
    assert server.run(tmp_path, *words, "--resume")[0] == 0
    assert_same(tmp_path, undisturbed[0])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_ignored_interrupt_stays_ignored(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """As in a script's background job, which SIGTERM ends as any other."""
    calls, save = [], resume.save_state

    def save_pressed(*words: Any) -> None:
        calls.append(words)
        if len(calls) == 1:
            signal.raise_signal(number)
        save(*words)

    monkeypatch.setattr(resume, "save_state", save_pressed)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        done = clod(capture.ply, "--images", capture.scene, *TINY, "--json")
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    assert done.code == 0 and json.loads(done.out)["interrupted"] == (number == signal.SIGTERM), done


def test_a_second_run_to_the_same_output(
    server: Server, words: list[Any], undisturbed: tuple[Path, float], tmp_path: Path, clod: Any
) -> None:
    """It is refused while the first one lives, stopped or not; the first one ends as if nothing had happened."""
    child = server.start(tmp_path, *words)
    wait_for(tmp_path / STATE, child)
    os.kill(child, signal.SIGSTOP)
    before = fingerprints(tmp_path / STATE)
    for more in ((), ("--resume",)):
        done = clod(*words, *more)
        assert done.code == 2 and f"dial.ply: another run (process {child}) is writing it; wait" in done.err, done
    assert fingerprints(tmp_path / STATE) == before
    os.kill(child, signal.SIGCONT)
    assert server.wait() == 0, log_of(tmp_path)
    assert_same(tmp_path, undisturbed[0])


def wait_for(path: Path, child: int) -> None:
    until = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < until, f"{path} did not appear"
        time.sleep(0.002)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 92 kB; skips where none can be mounted."""
    folder = tmp_path / "small"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=92k", "tmpfs", str(folder)]
    if sys.platform != "linux" or os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("only root can mount a small disk, and not everywhere")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk(
    server: Server, words: list[Any], capture: Any, small_disk: Path, undisturbed: tuple[Path, float]
) -> None:
    """The state fits once, the outputs do not: the last state is saved elsewhere, and --resume resumes from there."""
    before = fingerprints(capture.ply, capture.scene)
    code, log = server.run(small_disk, *words)
    assert code == 2 and names(small_disk) == [STATE], log
    *_, last = log.splitlines()
    assert re.match(r"clod-adapt: error: dial.ply: cannot be written: (No space left on device|\d+ requested)", last)
    assert log.count("the run continues") == 1 and load_state(small_disk / STATE)[0].steps == 1, log
    assert fingerprints(capture.ply, capture.scene) == before
    subprocess.run(["mount", "-o", "remount,size=1m", str(small_disk)], check=True)
    (kept,) = small_disk.parent.glob(f"clod-adapt-*/{STATE}")
    assert f"step {ITERS} is in {kept}: move it to {STATE}, and --resume resumes from there\n" in log
    shutil.move(kept, small_disk / STATE)
    code, log = server.run(small_disk, *words, "--resume")
    assert code == 0 and f"resuming {STATE} from step {ITERS}" in log, log
    assert_same(small_disk, undisturbed[0])


TINY = ("--iters", 12, "--max-sv", 4, "--out", "dial.ply")


@pytest.fixture
def broken_off(clod: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Runs the command up to where training has ended and is to be saved: the state after one step is there."""

    def run(*words: object) -> None:
        def stop(*_: Any) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(resume.Saver, "keep", stop)
            assert clod(*words).code == 130

    return run


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("--iters", 13), "is of a run with --iters 12; use the original arguments"),
        (("--seed", 5, "--time-budget", 9), "is of a run with no --time-budget, --seed 0; use"),
        (("--form", "paper"), "is of a run with another --form"),
    ],
)
def test_other_settings_are_refused(
    clod: Any,
    capture: Any,
    tmp_path: Path,
    broken_off: Any,
    monkeypatch: pytest.MonkeyPatch,
    changes: Any,
    message: str,
) -> None:
    words = (capture.ply, "--images", capture.scene, *TINY)
    broken_off(*words)
    before = fingerprints(tmp_path)
    monkeypatch.setattr(adapt_inputs, "read_checkpoint", lambda *_: pytest.fail("read"))
    done = clod(*words, *changes, "--resume")
    assert done.code == 2 and done.err.count("\n") == 1, done
    assert f"error: {STATE}: {message}" in done.err and fingerprints(tmp_path) == before


def test_other_inputs_are_refused(
    clod: Any, capture: Any, tmp_path: Path, broken_off: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken_off(capture.ply, "--images", capture.scene, *TINY)
    state = (tmp_path / STATE).read_bytes()
    other = capture.write(tmp_path / "other.ply", capture.gaussians.select(torch.arange(300) < 299))
    shutil.copytree(capture.scene, tmp_path / "fewer")
    Image.new("RGB", (64, 48)).save(tmp_path / "fewer" / "images" / "003.png")
    for ply, scene, what in (
        (other, capture.scene, "is of another checkpoint than other.ply"),
        (capture.ply, "fewer", "is of other photographs than fewer"),
    ):
        done = clod(ply if ply is capture.ply else "other.ply", "--images", scene, *TINY, "--resume")
        assert done.code == 2 and f"error: {STATE}: {what}; use the" in done.err, done
    monkeypatch.setattr(resume, "package_version", lambda: "0.0.7")
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--resume")
    assert (
        done.code == 2 and f"error: {STATE}: is of version {package_version()} of this package, not 0.0.7" in done.err
    )
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    broken = dict(load_file(tmp_path / STATE))
    broken["first.means"][0] = float("nan")
    with safe_open(tmp_path / STATE, framework="pt") as file:
        save_file(broken, tmp_path / STATE, file.metadata())
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--resume")
    assert done.code == 2 and done.err.splitlines()[-1] == (
        f"clod-adapt: error: {STATE}: the training state has impossible values of first.means; delete it to start over"
    )
    (tmp_path / STATE).write_bytes(state[:-9])
    for words in ([], ["--resume"]):  # what is no state, an adapter say, is not replaced either
        done = clod(capture.ply, "--images", capture.scene, *TINY, *words)
        assert done.code == 2 and f"error: {STATE}: is not a training state or is damaged" in done.err


def test_the_same_gaussians_in_another_file(clod: Any, capture: Any, tmp_path: Path, broken_off: Any) -> None:
    """And the same photographs in another folder: what they are counts, not where they are."""
    broken_off(capture.ply, "--images", capture.scene, *TINY)
    shutil.copy(capture.ply, tmp_path / "moved.ply")
    shutil.copytree(capture.scene, tmp_path / "moved")
    done = clod("moved.ply", "--images", "moved", *TINY, "--resume")
    assert done.code == 0 and f"resuming {STATE} from step 1" in done.err, done


def test_a_read_only_folder(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere, so chmod proves nothing
    monkeypatch.setattr(adapt_inputs, "read_checkpoint", lambda *_: pytest.fail("read"))
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--resume")
    assert done.code == 2 and "is not writable" in done.err and done.err.count("\n") == 1 and names(tmp_path) == []


def test_nothing_to_resume_from(clod: Any, capture: Any, tmp_path: Path) -> None:
    done = clod(capture.ply, "--images", capture.scene, *TINY, "--resume", "--json")
    assert done.code == 0 and f"there is no {STATE} to resume from: starting from the beginning" in done.err
    assert json.loads(done.out)["resumed_from"] is None and names(tmp_path) == OUTPUTS


def test_without_resume_a_state_is_replaced_only_by_the_next(
    clod: Any, capture: Any, tmp_path: Path, broken_off: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (capture.ply, "--images", capture.scene, *TINY)
    broken_off(*words)
    before, seen = (tmp_path / STATE).read_bytes(), []
    look = adapt_command.with_base_rows
    monkeypatch.setattr(
        adapt_command, "with_base_rows", lambda *a: seen.append((tmp_path / STATE).read_bytes()) or look(*a)
    )
    done = clod(*words, "--seed", 4)
    assert done.code == 0 and f"{STATE} has step 1 of an interrupted run" in done.err and seen == [before]
    assert names(tmp_path) == OUTPUTS


def test_a_state_that_cannot_be_saved_costs_a_warning(
    clod: Any, capture: Any, tmp_path: Path, broken_off: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And an earlier run's, which is then not replaced, is not removed either."""
    words = (capture.ply, "--images", capture.scene, *TINY)
    broken_off(*words)
    before = (tmp_path / STATE).read_bytes()

    def full(path: Path, *_: Any) -> None:
        raise ClodError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr(resume, "save_state", full)
    monkeypatch.setattr(resume, "SAVE_EVERY", 0.0)
    monkeypatch.setattr(resume, "SAVE_COST", 1e9)
    done = clod(*words, "--seed", 4)
    assert done.code == 0 and done.err.count(f"will not find it: {STATE}: cannot be written: No space") == 1
    assert names(tmp_path) == sorted([*OUTPUTS, STATE]) and (tmp_path / STATE).read_bytes() == before


def test_resuming_without_photographs(
    clod: Any, capture: Any, tmp_path: Path, broken_off: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inputs, "place_cameras", partial(inputs.place_cameras, views=4))
    words = (capture.ply, "--iters", 3, "--max-sv", 2, "--out")
    assert clod(*words, "whole.ply", "--quiet").code == 0
    broken_off(*words, "dial.ply")
    done = clod(*words, "dial.ply", "--resume", "--json")
    assert done.code == 0 and json.loads(done.out)["resumed_from"] == 1
    for kind in ("ply", "safetensors"):
        assert stripped((tmp_path / f"dial.{kind}").read_bytes()) == stripped((tmp_path / f"whole.{kind}").read_bytes())


def test_saves_take_their_share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the first step, then as often as saves of a tenth of a second take no more than 1.5 % of the time."""
    clock, saved = [0.0], []
    monkeypatch.setattr(resume.time, "perf_counter", lambda: clock[0])

    def save(path: Path, state: int, run_of: Any) -> None:
        saved.append(state)
        clock[0] += 0.1

    monkeypatch.setattr(resume, "save_state", save)
    saver = resume.Saver(tmp_path / STATE, {}, None, Console(quiet=True), GracefulStop())
    follow = saver.saving(lambda progress: None)
    for step in range(1, 601):
        clock[0] += 0.1
        follow(Progress(Phase.TRAINING, step, 600, clock[0], state=lambda step=step: step))
    assert saved[0] == 1 and 0.012 < saver.seconds / clock[0] <= 0.015 and saver.saves == len(saved) > 5


def test_sigterm_before_training(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapt_inputs, "prepare_kernels", lambda *_: signal.raise_signal(signal.SIGTERM))
    done = clod(capture.ply, "--images", capture.scene, *TINY)
    assert done.code == 130 and done.err.splitlines()[-1] == "clod-adapt: interrupted" and names(tmp_path) == []
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
