"""Runs the command, in its own process or, faster, in this one."""

import io
import json
import signal
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest

from clod_adapter.alignment import search
from clod_adapter.cli.main import main
from clod_adapter.progress import ENDING
from clod_adapter.training import camera_placement, pseudo_views
from runs import Server, accepted


@pytest.fixture(scope="session", autouse=True)
def signals_arrive():
    """Signals reach the tests and their child processes, also if the shell ignores or blocks
    them.
    """
    blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, earlier in before.items():
        signal.signal(number, earlier)
    signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@pytest.fixture(autouse=True)
def shorter(monkeypatch):
    """Cameras are placed for small images, few are added, and the search for another frame gives up
    early.
    """
    monkeypatch.setattr(camera_placement, "WIDTH", 62)
    monkeypatch.setattr(camera_placement, "HEIGHT", 46)
    monkeypatch.setattr(pseudo_views, "ADDED", 8)
    monkeypatch.setattr(search, "SCALES", [1.0])
    monkeypatch.setattr(search, "MOST_TRIALS", 8)


@pytest.fixture
def few_placed(monkeypatch):
    """Without photographs 16 cameras are placed."""
    few = partial(pseudo_views.place_cameras, views=16)
    monkeypatch.setattr(pseudo_views, "place_cameras", few)


class Done(NamedTuple):
    """What a run printed."""

    out: str
    err: str

    @property
    def report(self):
        """The object of ``--json``."""
        return json.loads(self.out)

    @property
    def output(self):
        """The one output of ``--json``."""
        (output,) = self.report["outputs"]
        return output

    def note(self, part):
        """The one note of ``--json`` that has this part."""
        (note,) = (note for note in self.report["notes"] if part in note)
        return note


@pytest.fixture(scope="session")
def run_in(capture, attenuated):
    """Runs ``clod-adapt`` in a folder, in this process, to the exit code ``code``; it ``accept``s
    its loss.

    Text is split into words, of which BASE, SCENE, DIAL and ADAPTER are the shared files.
    """
    places = (capture.ply, capture.scene, attenuated, attenuated.with_suffix(".safetensors"))
    shared = dict(zip(("BASE", "SCENE", "DIAL", "ADAPTER"), places, strict=True))

    def run(folder, *words, code=0, accept=True):
        out = io.StringIO()
        err = io.StringIO()
        given = []
        for word in words:
            parts = word.split() if isinstance(word, str) else [word]
            given += [str(shared.get(part, part)) for part in parts]
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
            patch.chdir(folder)
            try:
                found = main(accepted(given) if accept else given)
            except SystemExit as ended:  # argparse, for --help
                found = int(ended.code or 0)
        done = Done(out.getvalue(), err.getvalue())
        assert found == code, done
        return done

    return run


@pytest.fixture
def clod(run_in, tmp_path, monkeypatch):
    """``run_in`` with the test's folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return partial(run_in, tmp_path)


@pytest.fixture
def blank_figure(monkeypatch):
    """Replaces the figure of ``clod-adapt robustness``, which takes a second to draw, by an empty
    file.
    """
    monkeypatch.setattr(
        "clod_adapter.report.robustness_figure.robustness_figure",
        lambda path, *_: Path(path).touch(),
    )


@pytest.fixture(scope="session")
def server():
    """Starts ``clod-adapt`` in processes that need no seconds to start."""
    server = Server()
    yield server
    server.process.kill()
    server.process.communicate()
