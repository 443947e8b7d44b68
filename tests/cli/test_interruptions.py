"""Kills and signals: inputs are unchanged, outputs are complete or absent, and --resume gives the
same files.
"""

import json
import os
import pty
import signal
import time

import pytest

from clod_adapter import load, load_adapter, pipeline
from clod_adapter.cli.adapt import listeners
from clod_adapter.cli.shared import measure
from clod_adapter.training import planner
from clod_adapter.training.state import load_state
from runs import OUTPUTS, STATE, contents, log_of, names, pressed, pressing, results, wait_for

ITERS = 24


@pytest.fixture(scope="module")
def words(capture):
    options = f"--iters {ITERS} --max-sv 4 --out dial.ply"
    return [capture.ply, "--images", capture.scene, *options.split()]


@pytest.fixture(scope="module")
def undisturbed(server, words, tmp_path_factory):
    """The folder of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("undisturbed")
    server.run(folder, *words)
    return folder


def assert_whole(folder):
    """Outputs can be read, and all other files have the name of a temporary file."""
    readers = {
        ".json": lambda path: json.loads(path.read_text()),
        ".ply": load,
        ".safetensors": load_adapter,
    }
    for path in folder.iterdir():
        if path.name == STATE:
            load_state(path)
        elif not path.name.startswith(".tmp-"):
            assert path.name in OUTPUTS
            readers[path.suffix](path)


def report_in(folder):
    return json.loads((folder / "dial.json").read_text())


def assert_same(folder, want):
    """The same bits, except measured times, and no other files."""
    assert names(folder) == OUTPUTS, log_of(folder)
    assert results(folder) == results(want)
    report = report_in(folder)
    wanted = report_in(want)
    assert [row["psnr"] for row in report["rows"]] == [row["psnr"] for row in wanted["rows"]]
    assert report["steps"] == wanted["steps"] and not report["interrupted"]


def test_kills(server, words, capture, undisturbed, tmp_path):
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
    server, words, undisturbed, tmp_path, clod
):
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
    report = report_in(tmp_path)
    steps = report["steps"]
    assert code == 0 and "interrupted after" in log and "SIGTERM" not in log
    assert report["interrupted"] and report["resumed_from"] is None
    assert names(tmp_path) == BOTH and load_state(tmp_path / STATE)[0].steps == steps
    assert f"--resume resumes from step {steps}, which is in {STATE}" in log
    assert_whole(tmp_path)
    assert f"resuming {STATE} from step {steps}" in server.run(tmp_path, *words, "--resume")
    assert_same(tmp_path, undisturbed)
    assert report_in(tmp_path)["resumed_from"] == steps


INT = signal.SIGINT
TERM = signal.SIGTERM
SAVING = (listeners, "save_state")  # while training
BOTH = sorted([*OUTPUTS, STATE])
ABORTED = f"--resume resumes from step {ITERS}, which is in {STATE}\nclod-adapt: interrupted"
# where signals arrive, which, exit code, files, and the report's "interrupted" or the end of stderr
MOMENTS = [
    ((planner, "sh_degree_losses"), [INT], 130, [], "clod-adapt: interrupted"),
    (SAVING, [signal.SIGUSR1] * 3, 0, BOTH, True),
    (SAVING, [signal.SIGHUP] * 3, 0, BOTH, True),
    ((pipeline, "extract_adapter"), [INT], 0, BOTH, False),
    ((pipeline, "save_adapter"), [INT, TERM], 130, [STATE], ABORTED),
    ((pipeline, "save"), [INT], 0, OUTPUTS, False),  # the files without the page
]


@pytest.mark.parametrize("place, numbers, code, files, said", MOMENTS)
def test_signals_at_a_moment(clod, words, tmp_path, place, numbers, code, files, said):
    """Warnings may be repeated, as launchers do; a second Ctrl-C or SIGTERM aborts."""
    with pressed(*place, *numbers):
        done = clod(*words, "--json --report" if files == OUTPUTS else "--json", code=code)
    assert names(tmp_path) == files, done
    if code == 0:
        report = done.report
        assert report["interrupted"] == said and "page" not in report["outputs"]
        measured = place[1] != "extract_adapter"
        assert bool(report["rows"]) == bool(report["calibration"]) == measured
    else:
        assert done.err.rstrip().endswith(said)
    assert signal.getsignal(INT) is signal.default_int_handler
    assert signal.getsignal(TERM) is signal.SIG_DFL


@pytest.mark.parametrize("number", [INT, TERM])
def test_ignored_signals(clod, words, number):
    """They stay ignored, as in a background job of a script or below nohup; SIGTERM still ends
    training.
    """
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with pressed(*SAVING, number):
            assert clod(*words, "--json").report["interrupted"] == (number == TERM)
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)


def test_interrupts_of_the_measurement(clod, words, tmp_path, monkeypatch):
    """The first one keeps the finished rows; one after an interrupt of training aborts, as its
    message says.
    """
    real = measure.evaluate

    def evaluate(gaussians, views, dials, progress, **rest):
        if len(dials) == 5:
            progress = pressing(progress, INT, at=3 * len(views) + 1)
        return real(gaussians, views, dials, progress=progress, **rest)

    monkeypatch.setattr(measure, "evaluate", evaluate)
    done = clod(*words, "--json")
    report = done.report
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 1.5, 2]
    assert "measurements were interrupted" in report["notes"][0] in done.err
    assert report["interrupted"] is False and report["calibration"] is None
    assert load("dial.ply").quality_table is None and names(tmp_path) == BOTH
    with pressed(*SAVING, INT):
        done = clod(*words, code=130)
    assert "Ctrl-C again aborts without writing" in done.err and "interrupted after" in done.err


def test_closed_terminal_does_not_end_the_writing(server, words, tmp_path):
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
    assert report_in(tmp_path)["interrupted"]
    assert names(tmp_path) == BOTH
    assert_whole(tmp_path)
