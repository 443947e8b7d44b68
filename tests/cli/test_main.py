"""``cli/main.py``: exit codes, pipes, errors of every kind, ``--help``, and progress;
``clod-adapt doctor``.
"""

import io
import json
import re
import subprocess
import sys
import webbrowser
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch

from clod_adapter import rasterizers
from clod_adapter._support.text import package_version
from clod_adapter.cli.main import COMMANDS
from clod_adapter.cli.shared.console import Console, Meter, duration
from clod_adapter.rasterizers import reference

CAUSED = SystemError("returned a result with an exception set")  # as numba hands on a Ctrl-C
CAUSED.__cause__ = KeyboardInterrupt()
LITTLE = (
    "error: not enough memory \\(.*\\); free some memory, or raise the limit on it \\(ulimit -v\\)"
)
BUG = (
    f"error: this is a bug in clod-adapt {package_version()}, not in the input: please report it,"
    " with the lines"
)


@pytest.mark.parametrize(
    "error, code, said",
    [
        (
            OSError(28, "No space left on device", "a/file"),
            2,
            "error: a/file: No space left on device; check the path",
        ),
        (KeyboardInterrupt(), 130, "interrupted$"),
        (CAUSED, 130, "interrupted$"),
        (SystemError("of numba"), 1, BUG),
        (RuntimeError("unknown"), 1, BUG),
        (MemoryError(), 2, LITTLE),
        (RuntimeError("can't start new thread"), 2, LITTLE),
        (torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."), 2, LITTLE),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), 2, LITTLE),
    ],
)
def test_errors_of_the_work(clod, monkeypatch, error, code, said):
    """One line, with --json also an object on stdout; below a traceback only where the error is
    ours.
    """
    monkeypatch.setattr("clod_adapter.cli.shared.inputs.load", Mock(side_effect=error))
    done = clod("eval BASE --images SCENE --json --quiet", code=code)
    lines = done.err.splitlines()
    assert done.report["code"] == code and lines[-1].endswith(done.report["error"])
    assert re.match(f"clod-adapt: {said}", lines[-1]), done
    assert (lines[0] == "Traceback (most recent call last):") == (code == 1) == (len(lines) > 1)
    assert code != 1 or str(error) in lines[-2]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has this device")
@pytest.mark.parametrize("words", ["inspect PLY --json", "--help"])
def test_results_that_cannot_be_printed_are_an_error(capture, words):
    given = [str(capture.ply) if word == "PLY" else word for word in words.split()]
    command = [sys.executable, "-m", "clod_adapter", *given]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    said = (
        "clod-adapt: error: stdout cannot be written (No space left on device), so the result is"
        " lost; open it\n"
    )
    assert (done.returncode, done.stderr) == (2, said)


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(clod, command, monkeypatch):
    """Options are grouped: inputs come first and general options last; none is outside a group."""
    monkeypatch.setenv("COLUMNS", "80")
    done = clod(command, "--help")
    assert done.out.startswith("usage: clod-adapt") and "--json" in done.out
    *lines, page = done.out.splitlines()
    assert max(map(len, lines)) <= 80 and page.startswith("manual: ") and page.endswith("index.md")
    # Python 3.13 writes "-o, --out X", 3.12 "-o X, --out X"
    short = re.search(r"\n  -o[ ,]", done.out) is not None
    assert ("--out " in done.out) == short == (command not in ("eval", "inspect", "view", "doctor"))
    titles = re.findall(r"(?m)^(\w[\w ,]*):\n  (?:-|[A-Z])", done.out)
    titles = titles[: titles.index("general") + 1]
    assert titles[0] == {"demo": "output", "doctor": "general"}.get(command, "input")
    assert not {"positional arguments", "options"} & set(titles)
    if not command:
        assert all(f"clod-adapt {other}" in done.out for other in COMMANDS)
        done = clod()
        assert done.out.count("\n") == 5 and "clod-adapt PLY --images DIR" in done.out
        assert done.err == ""
        assert clod("--version").out.split() == ["clod-adapt", package_version()]


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_lines_without_a_terminal(capsys, monkeypatch):
    now = 0.0
    clock = SimpleNamespace(perf_counter=lambda: now)
    monkeypatch.setattr("clod_adapter.cli.shared.console.time", clock)
    meter = Meter(Console(), "training")
    for now in range(1, 21):
        meter.update(now / 90, f"step {now}")
    assert capsys.readouterr().err.splitlines() == [
        f"training  {share}%, {left} left, step {step}"
        for share, left, step in ((11, "1:20", 10), (22, "1:10", 20))
    ]
    now = 10.0  # the time left does not count the work of an earlier run
    meter.begin("training", initial=0.5)
    meter.began = meter.printed = 0.0
    meter.update(0.6)
    assert capsys.readouterr().err == "training  60%, 40 s left\n"
    for seconds, text in (
        (0.04, "0.0 s"),
        (9.96, "10 s"),
        (59.7, "1:00"),
        (125, "2:05"),
        (3725, "1:02:05"),
    ):
        assert duration(seconds) == text


def test_status_and_quiet(monkeypatch):
    """A status is shown on a terminal, until the block ends."""
    for quiet, stream in ((False, Terminal()), (True, Terminal()), (False, io.StringIO())):
        monkeypatch.setattr(sys, "stderr", stream)
        console = Console(quiet)
        with pytest.raises(KeyboardInterrupt), console.status("reading a file ..."):
            assert ("\rreading a file ..." in stream.getvalue()) == (stream.isatty() and not quiet)
            raise KeyboardInterrupt
        assert not stream.getvalue().split("\r")[-1].strip() and "\n" not in stream.getvalue()
        console.say("a line")
        assert stream.getvalue().endswith("a line\n") != quiet


NAMES = ["torch", "cpu", "gsplat", "browser"]


def test_lines_of_this_machine(clod, monkeypatch):
    for browser, ok in (
        (webbrowser.GenericBrowser("lynx"), "off "),
        (webbrowser.BackgroundBrowser("firefox"), "ok "),
    ):
        monkeypatch.setattr(webbrowser, "get", Mock(return_value=browser))
        done = clod("doctor")
        *lines, last = done.out.replace("\n    -> ", "  -> ").splitlines()
        assert [line.split()[0] for line in lines] == NAMES and lines[3][9:].startswith(ok), done
        # what fails has its fix
        assert all((line[9:12] == "ok ") != (" -> " in line) for line in lines)
    assert lines[1].startswith("cpu      ok   renders the reference image (RMS ")
    assert last.startswith("rendering and training backends: cpu")


def test_json_without_torch():
    """Run as a module, as by torchrun."""
    code = (
        "import sys, runpy; sys.modules['torch'] = None; sys.argv = ['clod-adapt', 'doctor',"
        " '--json']\n"
    )
    code += "runpy.run_module('clod_adapter', run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    report = json.loads(done.stdout)
    assert set(report) == {"command", "version", "draws", "exit_code", "findings"}
    assert report["draws"] == []
    assert done.returncode == report["exit_code"] == 1, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    found = {each["name"]: each for each in report["findings"]}
    assert [*found] == NAMES
    assert found["torch"]["fix"].startswith("pip install")
    assert not found["cpu"]["ok"]
    said = "no rendering backend works: fix torch first, then the CPU backend\n"
    assert done.stderr.endswith(f"\n{said}")


@pytest.mark.parametrize(
    "change", [lambda image: image.roll(1, 1), lambda image: image * torch.nan]
)
def test_a_wrong_image_is_reported(clod, monkeypatch, change):
    def rasterize(**given):
        image, alpha = reference.rasterize(**given)
        return change(image), alpha

    monkeypatch.setitem(rasterizers.BACKENDS, "cpu", lambda: rasterizers.Rasterizer(rasterize))
    report = clod("doctor --json --quiet", code=1).report
    found = {found["name"]: found for found in report["findings"]}
    assert found["cpu"]["found"].startswith("renders another image than the reference")
    assert found["torch"]["ok"] and not found["cpu"]["ok"]
