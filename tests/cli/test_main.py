"""``cli/main.py``: exit codes, pipes, errors of every kind, and ``--help``."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from clod_adapter._support.version import package_version
from clod_adapter.cli.main import COMMANDS

CAUSED = SystemError("returned a result with an exception set")  # as numba hands on a Ctrl-C
CAUSED.__cause__ = KeyboardInterrupt()
LITTLE = "error: not enough memory \\(.*\\); free some memory, or raise the limit on it \\(ulimit -v\\)"
BUG = f"error: this is a bug in clod-adapt {package_version()}, not in the input: please report it, with the lines"


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (OSError(28, "No space left on device", "a/file"), 2, "error: a/file: No space left on device; check the path"),
        (KeyboardInterrupt(), 130, "interrupted$"), (CAUSED, 130, "interrupted$"),
        (SystemError("of numba"), 1, BUG), (RuntimeError("unknown"), 1, BUG),
        (MemoryError(), 2, LITTLE), (RuntimeError("can't start new thread"), 2, LITTLE),
        (torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."), 2, LITTLE),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), 2, LITTLE),
    ],
)  # fmt: skip
def test_errors_of_the_work(
    clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, said: str
) -> None:
    """One line, with --json also an object on stdout; below a traceback only where the error is ours."""

    def read(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("clod_adapter.cli.shared.inputs.load", read)
    done = clod("eval", capture.ply, "--images", capture.scene, "--json", "--quiet")
    lines, found = done.err.splitlines(), json.loads(done.out)
    assert done.code == found["code"] == code and lines[-1].endswith(found["error"]), done
    assert re.match(f"clod-adapt: {said}", lines[-1]), done
    assert (lines[0] == "Traceback (most recent call last):") == (code == 1) == (len(lines) > 1)
    assert code != 1 or str(error) in lines[-2]


def test_without_arguments_it_says_what_to_do(clod: Any) -> None:
    done = clod()
    assert (done.code, done.err, done.out.count("\n")) == (0, "", 5) and "clod-adapt PLY --images DIR" in done.out


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has this device")
@pytest.mark.parametrize("words", ["inspect PLY --json", "--help"])
def test_results_that_cannot_be_printed_are_an_error(capture: Any, words: str) -> None:
    command = [sys.executable, "-m", "clod_adapter", *words.replace("PLY", str(capture.ply)).split()]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    said = "clod-adapt: error: stdout cannot be written (No space left on device), so the result is lost; open it\n"
    assert (done.returncode, done.stderr) == (2, said)


def test_a_file_of_nearly_a_commands_name(clod: Any, tmp_path: Path) -> None:
    (tmp_path / "veiw").touch()
    assert "did you mean" not in clod("veiw").err


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(clod: Any, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options are grouped: inputs come first and general options last; none is outside a group."""
    monkeypatch.setenv("COLUMNS", "80")
    done = clod(*command.split(), "--help")
    assert done.code == 0 and done.out.startswith("usage: clod-adapt") and "--json" in done.out
    *lines, page = done.out.splitlines()
    assert max(map(len, lines)) <= 80 and page.startswith("manual: ") and page.endswith("index.md")
    short = re.search(r"\n  -o[ ,]", done.out) is not None  # Python 3.13 writes "-o, --out X", 3.12 "-o X, --out X"
    assert ("--out " in done.out) == short == (command not in ("eval", "inspect", "view", "doctor"))
    titles = re.findall(r"(?m)^(\w[\w ,]*):\n  (?:-|[A-Z])", done.out)
    titles = titles[: titles.index("general") + 1]
    assert titles[0] == {"demo": "output", "doctor": "general"}.get(command, "input")
    assert not {"positional arguments", "options"} & set(titles)
    if not command:
        assert all(f"clod-adapt {other}" in done.out for other in COMMANDS)
        assert clod("--version").out.split() == ["clod-adapt", package_version()]
