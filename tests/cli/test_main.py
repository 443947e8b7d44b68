"""``cli/main.py``: exit codes, signals, pipes, and errors of every kind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from clod_adapter._support.version import package_version
from runs import fail


def test_oserror_is_one_line(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device", "some/file")

    monkeypatch.setattr("clod_adapter.cli.shared.inputs.read_scene", full)
    done = clod("eval", capture.ply, "--images", capture.scene)
    assert (done.code, done.out) == (2, ""), done
    assert done.err.splitlines()[-1].startswith("clod-adapt: error: some/file: No space left on device; check")


def test_torch_is_imported_with_idle_threads_and_the_collector_on() -> None:
    """The command sets OpenMP's wait policy before torch reads it."""
    code = (
        "import sys, gc, os\n"
        "class Spy:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name == 'torch': print(os.environ.get('OMP_WAIT_POLICY'))\n"
        "sys.meta_path.insert(0, Spy())\n"
        "from clod_adapter.cli.main import import_library\n"
        "import_library(quiet=True)\n"
        "assert 'torch' in sys.modules\n"
        "assert gc.isenabled() and gc.get_freeze_count() > 1000\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split()[0] == "PASSIVE"


def test_ctrl_c_within_compiled_code(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba's dispatcher raises a SystemError from it; other SystemErrors are bugs."""
    for cause, code, last in ((KeyboardInterrupt(), 130, "clod-adapt: interrupted"), (None, 1, "please report it")):

        def read(*_: object, cause: BaseException | None = cause) -> None:
            raise SystemError("returned a result with an exception set") from cause

        monkeypatch.setattr("clod_adapter.cli.shared.inputs.read_checkpoint", read)
        done = clod("eval", capture.ply, "--images", capture.scene)
        assert done.code == code and last in done.err.splitlines()[-1], done


def test_unexpected_error_prints_a_traceback_and_where_to_report_it(
    clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clod_adapter.cli.shared.inputs.read_checkpoint", fail)
    done = clod("eval", capture.ply, "--images", capture.scene, "--json", "--quiet")
    lines = done.err.splitlines()
    assert done.code == 1 and lines[0] == "Traceback (most recent call last):", done
    assert lines[-2] == "ZeroDivisionError: of ours" and 'raise ZeroDivisionError("of ours")' in done.err
    assert lines[-1].startswith(f"clod-adapt: error: this is a bug in clod-adapt {package_version()}, not in the input")
    assert "please report it, with the lines above" in lines[-1]


def test_errors_are_one_json_object(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bad input, an interrupt and a fault of ours; on stdout, beside the line on stderr."""
    words = ("eval", capture.ply, "--images", capture.scene, "--json")
    done = clod(*words, "--sv=-1")
    assert json.loads(done.out) == {
        "error": "--sv has -1, it must be at least 0 (1 is full quality, 0 everything)",
        "code": 2,
    }
    for error, code, said in ((KeyboardInterrupt(), 130, "interrupted"), (ZeroDivisionError(), 1, "this is a bug in")):

        def read(*_: object, error: BaseException = error) -> None:
            raise error

        monkeypatch.setattr("clod_adapter.cli.shared.inputs.read_scene", read)
        done = clod(*words)
        found = json.loads(done.out)
        assert done.code == found["code"] == code and found["error"].startswith(said), done
        assert done.err.splitlines()[-1].endswith(found["error"])


@pytest.mark.parametrize(("word", "command"), [("veiw", "view"), ("Eval", "eval"), ("robustnes", "robustness")])
def test_a_misspelt_command_is_suggested(clod: Any, tmp_path: Path, word: str, command: str) -> None:
    done = clod(word, "some.ply")
    assert done.code == 2 and f"{word}: no such file or command; did you mean clod-adapt {command}?\n" in done.err
    (tmp_path / word).touch()
    assert "did you mean" not in clod(word).err  # a file


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has this device")
@pytest.mark.parametrize("words", ["inspect PLY", "inspect PLY --json", "--help"])
def test_results_that_cannot_be_printed_are_an_error(capture: Any, words: str) -> None:
    command = [sys.executable, "-m", "clod_adapter", *words.replace("PLY", str(capture.ply)).split()]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    said = "clod-adapt: error: stdout cannot be written (No space left on device), so the result is lost; open it\n"
    assert (done.returncode, done.stderr) == (2, said)
