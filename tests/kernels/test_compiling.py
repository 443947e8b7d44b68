"""Compiled kernels: cached where that is possible, and working where it is not."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

CODE = """
import torch
from clod_adapter._kernels import tiles
from clod_adapter.losses import photometric_loss
loss = photometric_loss(torch.ones(4, 4, 3), torch.full((4, 4, 3), 255).byte(), 1.0)
print(type(tiles.radix_sort._cache).__name__, round(1 - float(loss), 3))
"""


def run(**environment: str) -> str:
    command = [sys.executable, "-c", CODE]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_folder_that_cannot_be_written_only_costs_the_cache() -> None:
    nowhere = os.path.join(os.devnull, "cache")
    locators = {"NUMBA_CACHE_DIR": nowhere, "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
    assert run(**locators) == "NullCache 1.0"


def test_kernels_are_cached() -> None:
    assert run() == "_Cache 1.0"


def test_a_switch_that_turns_compiling_off(capture: Any, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "clod_adapter", str(capture.ply), "--out", str(tmp_path / "dial.ply")]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and os.listdir(tmp_path) == []
    assert done.stderr == ("clod-adapt: error: NUMBA_DISABLE_JIT is set, and the kernels run compiled only; unset it\n")


@pytest.fixture
def number(tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """Starts a process that prints what a kernel of one line gives for ``[1.0]``; ``version`` is added to it."""

    def start(version: int, before: str = "", kind: str = "float32") -> subprocess.Popen[str]:
        """The versions differ in the kernels' stamp, as they do where a part of the kernel in another file changed."""
        (tmp_path / "constant.py").write_text(f"VERSION = {version}.0")
        (tmp_path / "sums.py").write_text(
            "from clod_adapter._kernels import compiling\n"
            "from constant import VERSION\n"
            "compiling._STAMP = str(VERSION)\n"
            "@compiling.kernel\n"
            "def f(x):\n"
            "    return x[0] + VERSION\n"
        )
        code = f"import sums, os, numpy\n{before}\nprint(sums.f(numpy.ones(1, numpy.{kind})))"
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", ""), root])
        places = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.Popen(
            [sys.executable, "-c", code], env=os.environ | places, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    return start


def said(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return out.strip()


@pytest.mark.parametrize("written", [0, 1])
def test_a_process_that_dies_while_it_writes_leaves_nothing_wrong(
    number: Callable[..., subprocess.Popen[str]], written: int
) -> None:
    """Above all not the code of the version before."""
    assert said(number(1)) == "2.0"
    dies = f"left = [os.replace] * {written}\nos.replace = lambda *a: left.pop()(*a) if left else os._exit(9)"
    number(5, dies).communicate(timeout=60)
    assert said(number(5)) == "6.0"


def test_a_full_disk_costs_the_cache_only(number: Callable[..., subprocess.Popen[str]]) -> None:
    full = "def full(*_): raise OSError(28, 'No space left on device')\nos.replace = full"
    assert said(number(1, full)) == "2.0" and said(number(1)) == "2.0"


@pytest.mark.parametrize("left", [0.0, 0.5])
def test_a_damaged_file_is_compiled_again(
    number: Callable[..., subprocess.Popen[str]], tmp_path: Path, left: float
) -> None:
    assert said(number(1)) == "2.0"
    files = [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]
    whole = {path: path.read_bytes() for path in files}
    for path, data in whole.items():
        path.write_bytes(data[: int(left * len(data))])
    assert said(number(1)) == "2.0"
    assert all(len(path.read_bytes()) == len(data) for path, data in whole.items())


def test_several_processes_at_once(number: Callable[..., subprocess.Popen[str]]) -> None:
    """With different variants, on an empty cache; what they leave serves all."""
    kinds = ("float32", "float64", "int32", "float32")
    assert [said(process) for process in [number(1, kind=kind) for kind in kinds]] == ["2.0"] * 4
    hits = "import atexit; atexit.register(lambda: print(sum(sums.f.stats.cache_hits.values())))"
    assert [said(number(1, hits, kind)) for kind in kinds] == ["2.0\n1"] * 4
