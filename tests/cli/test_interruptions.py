"""Kills and signals: inputs are unchanged, outputs are complete or absent, and --resume gives the
same files.
"""

import json
import os
import pty
import signal
import time
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter import load, pipeline
from clod_adapter.cli.adapt import listeners
from clod_adapter.cli.shared import measure
from clod_adapter.training import planner
from clod_adapter.training.state import load_state
from runs import OUTPUTS, STATE, Server, contents, log_of, names, pressing, results, wait_for

ITERS = 24


@pytest.fixture(scope="module")
def words(capture: Any) -> list[Any]:
    return [
        capture.ply,
        "--images",
        capture.scene,
        "--iters",
        ITERS,
        "--max-sv",
        4,
        "--out",
        "dial.ply",
    ]


@pytest.fixture(scope="module")
def undisturbed(server: Server, words: list[Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("undisturbed")
    server.run(folder, *words)
    return folder


def assert_whole(folder: Path) -> None:
    """Outputs can be read, and all other files have the name of a temporary file."""
    readers = [
        lambda path: json.loads(path.read_text()),
        load,
        clod_adapter.load_adapter,
    ]
    known = dict(zip(OUTPUTS, readers, strict=True)) | {STATE: load_state}
    for path in folder.iterdir():
        assert path.name in known or path.name.startswith(".tmp-")
        known.get(path.name, Path.stat)(path)


def assert_same(folder: Path, want: Path) -> None:
    """The same bits, except measured times, and no other files."""
    assert names(folder) == OUTPUTS, log_of(folder)
    assert results(folder) == results(want)
    found, wanted = (json.loads((path / "dial.json").read_text()) for path in (folder, want))
    assert [row["psnr"] for row in found["rows"]] == [row["psnr"] for row in wanted["rows"]]
    assert found["steps"] == wanted["steps"] and not found["interrupted"]


def test_kills(
    server: Server, words: list[Any], capture: Any, undisturbed: Path, tmp_path: Path
) -> None:
    """A run that replaces earlier files is killed soon after a state was saved, and later, and
    resumed.
    """
    inputs = contents(capture.ply, capture.scene)
    server.run(tmp_path, *words, "--seed", 4)
    child = server.start(tmp_path, *words)
    for delay in (0.0, 0.4):
        wait_for(tmp_path / STATE)
        time.sleep(delay)
        os.kill(child, signal.SIGKILL)
        assert server.wait(child) in (0, -signal.SIGKILL) and "Traceback" not in log_of(tmp_path)
        assert_whole(tmp_path)
        child = server.start(tmp_path, *words, "--resume")
    assert server.wait(child) == 0, log_of(tmp_path)
    assert_same(tmp_path, undisturbed)
    assert contents(capture.ply, capture.scene) == inputs


def test_one_interrupt_of_training_writes_the_result_so_far(
    server: Server, words: list[Any], undisturbed: Path, tmp_path: Path, clod: Any
) -> None:
    """The state is written too, and the log has only the command's lines. No other run may write
    there before.
    """
    child = server.start(tmp_path, *words)
    wait_for(tmp_path / STATE)
    os.kill(child, signal.SIGSTOP)
    before = contents(tmp_path / STATE)
    assert "dial.ply: another run is writing it; wait" in clod(*words, "--resume", code=2).err
    assert contents(tmp_path / STATE) == before
    os.kill(child, signal.SIGINT)
    os.kill(child, signal.SIGCONT)
    code = server.wait(child)
    log = log_of(tmp_path)
    report = json.loads((tmp_path / "dial.json").read_text())
    assert code == 0, log
    assert report["interrupted"], log
    assert report["resumed_from"] is None, log
    assert "interrupted after" in log
    assert names(tmp_path) == sorted([*OUTPUTS, STATE])
    assert load_state(tmp_path / STATE)[0].steps == report["steps"]
    assert f"--resume resumes from step {report['steps']}, which is in {STATE}" in log
    assert "SIGTERM" not in log
    assert_whole(tmp_path)
    assert f"resuming {STATE} from step {report['steps']}" in server.run(
        tmp_path, *words, "--resume"
    )
    assert_same(tmp_path, undisturbed)
    assert json.loads((tmp_path / "dial.json").read_text())["resumed_from"] == report["steps"]


INT = signal.SIGINT
TERM = signal.SIGTERM
SAVING = (listeners, "save_state")
BOTH = sorted([*OUTPUTS, STATE])  # while training
ABORTED = f"--resume resumes from step {ITERS}, which is in {STATE}\nclod-adapt: interrupted"
# where signals arrive, which, exit code, files, and the report's "interrupted" or the end of stderr
MOMENTS = [
    ((planner, "sh_degree_losses"), [INT], 130, [], "clod-adapt: interrupted"),
    (SAVING, [signal.SIGUSR1] * 3, 0, BOTH, True),
    (SAVING, [signal.SIGHUP] * 3, 0, BOTH, True),
    ((pipeline, "extract"), [INT], 0, BOTH, False),
    ((pipeline, "save_adapter"), [INT, TERM], 130, [STATE], ABORTED),
    ((pipeline, "save"), [INT], 0, OUTPUTS, False),  # the files without the page
]


@pytest.mark.parametrize("place, numbers, code, files, said", MOMENTS)
def test_signals_at_a_moment(
    clod: Any,
    words: Any,
    tmp_path: Path,
    monkeypatch: Any,
    place: Any,
    numbers: Any,
    code: int,
    files: Any,
    said: Any,
) -> None:
    """Warnings may be repeated, as launchers do; a second Ctrl-C or SIGTERM aborts."""
    monkeypatch.setattr(*place, pressing(getattr(*place), *numbers))
    done = clod(*words, "--json --report" if files == OUTPUTS else "--json", code=code)
    assert names(tmp_path) == files, done
    if code == 0:
        assert done.report["interrupted"] == said and "page" not in done.report["outputs"]
        assert (
            bool(done.report["rows"]) == bool(done.report["calibration"]) == (place[1] != "extract")
        )
    else:
        assert done.err.rstrip().endswith(said)
    assert signal.getsignal(INT) is signal.default_int_handler
    assert signal.getsignal(TERM) is signal.SIG_DFL


@pytest.mark.parametrize("number", [INT, TERM])
def test_ignored_signals(
    clod: Any, words: list[Any], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """They stay ignored, as in a background job of a script or below nohup; SIGTERM still ends
    training.
    """
    monkeypatch.setattr(*SAVING, pressing(listeners.save_state, number))
    before = signal.signal(number, signal.SIG_IGN)
    try:
        assert clod(*words, "--json").report["interrupted"] == (number == TERM)
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)


def test_interrupts_of_the_measurement(
    clod: Any, words: list[Any], tmp_path: Path, monkeypatch: Any
) -> None:
    """The first one keeps the finished rows; one after an interrupt of training aborts, as its
    message says.
    """
    real = measure.evaluate

    def evaluate(gaussians: Any, views: Any, dials: list[float], progress: Any, **rest: Any) -> Any:
        pressed = pressing(progress, INT, at=3 * len(views) + 1)
        return real(
            gaussians, views, dials, progress=pressed if len(dials) == 5 else progress, **rest
        )

    monkeypatch.setattr(measure, "evaluate", evaluate)
    report = (done := clod(*words, "--json")).report
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 1.5, 2]
    assert "measurements were interrupted" in report["notes"][0] in done.err
    assert report["interrupted"] is False
    assert report["calibration"] is None
    assert load(tmp_path / "dial.ply").calibration is None
    assert names(tmp_path) == BOTH
    monkeypatch.setattr(*SAVING, pressing(listeners.save_state, INT))
    done = clod(*words, code=130)
    assert "Ctrl-C again aborts without writing" in done.err and "interrupted after" in done.err


def test_closed_terminal_does_not_end_the_writing(
    server: Server, words: list[Any], tmp_path: Path
) -> None:
    """It sends SIGHUP, and writing to it is an error."""
    terminal, other = pty.openpty()
    before = f"os.setsid(); terminal = os.open({os.ttyname(other)!r}, os.O_RDWR); "
    before += "sys.stdout, sys.stderr = (open(terminal, 'w', closefd=False) for _ in range(2)); "
    before += "signal.signal(signal.SIGHUP, signal.SIG_DFL)"
    child = server.start(tmp_path, *words, "--iters", 4000, before=before)
    wait_for(tmp_path / STATE)
    os.close(other)
    os.close(terminal)
    assert server.wait(child) == 0
    assert json.loads((tmp_path / "dial.json").read_text())["interrupted"]
    assert names(tmp_path) == BOTH
    assert_whole(tmp_path)
