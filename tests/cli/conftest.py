"""Runs the command, in its own process or, faster, in this one."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from clod_adapter.cli.main import main
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


class Done:
    """Exit code, stdout and stderr."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err

    def __repr__(self) -> str:
        return f"exit {self.code}\n--- stdout\n{self.out}\n--- stderr\n{self.err}"


@pytest.fixture
def clod(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Done]:
    """Runs ``clod-adapt`` with these words, in this process, with the test's folder as the current one."""
    monkeypatch.chdir(tmp_path)

    def run(*words: object) -> Done:
        capsys.readouterr()
        try:
            code = main(accepted(words))
        except SystemExit as done:  # argparse, for --help
            code = int(done.code or 0)
        return Done(code, *capsys.readouterr())

    return run


@pytest.fixture
def blank_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces the figure of ``clod-adapt robustness``, which takes a second to draw, by an empty file."""
    monkeypatch.setattr("clod_adapter.report.robustness_figure.robustness_figure", lambda path, *_: Path(path).touch())


@pytest.fixture(scope="session")
def spawn() -> Callable[..., subprocess.Popen[str]]:
    """Starts ``clod-adapt`` with these words in a process of its own, with a progress line every ``line_every`` s."""

    def start(*words: object, cwd: Path, line_every: float = 10) -> subprocess.Popen[str]:
        code = "import sys; from clod_adapter.cli import main; from clod_adapter.cli.shared import console; "
        code += f"console.LINE_EVERY = {line_every}"
        command = [sys.executable, "-c", f"{code}; sys.exit(main.main())", *accepted(words)]
        return subprocess.Popen(command, cwd=cwd, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    return start


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """Starts ``clod-adapt`` in processes that need no seconds to start."""
    server = Server()
    yield server
    server.process.kill()
    server.process.communicate()
