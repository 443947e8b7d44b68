"""Runs the command, in its own process or, faster, in this one."""

import io
import signal
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest

from clod_adapter.alignment import search
from clod_adapter.cli.main import main
from clod_adapter.training import camera_placement, pseudo_views
from clod_adapter.training.interrupts import ENDING
from runs import Server, accepted


@pytest.fixture(scope="session", autouse=True)
def signals_arrive() -> Iterator[None]:
    """Signals reach the tests and their child processes, also if the shell ignores or blocks them."""
    blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, earlier in before.items():
        signal.signal(number, earlier)
    signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@pytest.fixture(autouse=True)
def shorter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras are placed for small images, few are added, and the search for another frame gives up early."""
    for module, changes in (
        (camera_placement, {"WIDTH": 62, "HEIGHT": 46}), (pseudo_views, {"ADDED": 8}),
        (search, {"SCALES": [1.0], "MOST_TRIALS": 8}),
    ):  # fmt: skip
        for name, value in changes.items():
            monkeypatch.setattr(module, name, value)


class Done(NamedTuple):
    code: int
    out: str
    err: str


def command(*words: object, accept: bool = True) -> Done:
    """Runs ``clod-adapt`` with these words in this process; adapting ``accept``s its loss (``runs.accepted``)."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main(accepted(words) if accept else [str(word) for word in words])
        except SystemExit as done:  # argparse, for --help
            code = int(done.code or 0)
    return Done(code, out.getvalue(), err.getvalue())


@pytest.fixture
def clod(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Done]:
    """``command`` with the test's folder as the current one."""
    monkeypatch.chdir(tmp_path)
    return command


@pytest.fixture(scope="session")
def run_in() -> Callable[..., Done]:
    """``command`` in a folder, for fixtures that several tests share."""

    def run(folder: Path, *words: object, accept: bool = True) -> Done:
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            return command(*words, accept=accept)

    return run


@pytest.fixture
def blank_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces the figure of ``clod-adapt robustness``, which takes a second to draw, by an empty file."""
    monkeypatch.setattr("clod_adapter.report.robustness_figure.robustness_figure", lambda path, *_: Path(path).touch())


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """Starts ``clod-adapt`` in processes that need no seconds to start."""
    server = Server()
    yield server
    server.process.kill()
    server.process.communicate()
