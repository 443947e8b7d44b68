"""The cache of compiled kernels, and its failures."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Start = Callable[..., subprocess.Popen[str]]


def test_disabled_compilation_is_an_error(capture: Any, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "clod_adapter", str(capture.ply), "--out", str(tmp_path / "dial.ply")]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and os.listdir(tmp_path) == []
    last = done.stderr.splitlines()[-1]
    assert last == "clod-adapt: error: NUMBA_DISABLE_JIT is set, and the kernels run compiled only; unset it"


@pytest.fixture
def number(tmp_path: Path) -> Start:
    """Starts a process that prints the result of a one-line kernel for ``[1.0]``: 1 + ``version``.

    The versions differ in the kernels' stamp, as after a change of an inlined function.
    """
    (tmp_path / "sums.py").write_text(
        "from clod_adapter._kernels import compiling\n"
        "from constant import VERSION\n"
        "compiling._STAMP = str(VERSION)\n"
        "@compiling.kernel\n"
        "def f(x):\n"
        "    return x[0] + VERSION\n"
    )

    def start(version: int, before: str = "", kind: str = "float32", cache: str = "") -> subprocess.Popen[str]:
        (tmp_path / "constant.py").write_text(f"VERSION = {version}.0")
        code = f"import sums, os, numpy\n{before}\nprint(sums.f(numpy.ones(1, numpy.{kind})))"
        root = str(Path(__file__).resolve().parents[2])
        environment = os.environ | {
            "NUMBA_CACHE_DIR": cache or str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", ""), root]),
        }  # fmt: skip
        pipe = subprocess.PIPE
        return subprocess.Popen([sys.executable, "-c", code], env=environment, text=True, stdout=pipe, stderr=pipe)

    return start


def said(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return out.strip()


def test_cache_survives_a_process_killed_while_writing(number: Start) -> None:
    """The code of the previous version is not used."""
    assert said(number(1)) == "2.0"
    number(5, "os.replace = lambda *a: os._exit(9)").communicate(timeout=60)
    assert said(number(5)) == "6.0"


def test_kernels_run_without_a_writable_cache(number: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    full = "def full(*_): raise OSError(28, 'No space left on device')\nos.replace = full"
    assert said(number(1, full)) == "2.0"
    monkeypatch.setenv("NUMBA_CACHE_LOCATOR_CLASSES", "UserProvidedCacheLocator")
    process = number(1, "print(type(sums.f._cache).__name__)", cache=os.path.join(os.devnull, "cache"))
    assert said(process) == "NullCache\n2.0"
