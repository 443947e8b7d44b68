"""Compiled kernels: cached where that is possible, and working where it is not."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

CACHE = "from clod_adapter._kernels import tiles; print(type(tiles.radix_sort._cache).__name__)"


def test_kernels_are_cached() -> None:
    done = subprocess.run([sys.executable, "-c", CACHE], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "_Cache", done.stderr


def test_a_switch_that_turns_compiling_off(capture: Any, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "clod_adapter", str(capture.ply), "--out", str(tmp_path / "dial.ply")]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and os.listdir(tmp_path) == []
    assert done.stderr == ("clod-adapt: error: NUMBA_DISABLE_JIT is set, and the kernels run compiled only; unset it\n")


@pytest.fixture
def number(tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """Starts a process that prints what a kernel of one line gives for ``[1.0]``; ``version`` is added to it."""

    def start(version: int, before: str = "", kind: str = "float32", cache: str = "") -> subprocess.Popen[str]:
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
        places = {
            "NUMBA_CACHE_DIR": cache or str(tmp_path / "cache"),
            "PYTHONPATH": path,
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        return subprocess.Popen(
            [sys.executable, "-c", code], env=os.environ | places, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    return start


def said(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return out.strip()


def test_a_process_that_dies_while_it_writes_leaves_nothing_wrong(
    number: Callable[..., subprocess.Popen[str]],
) -> None:
    """Above all not the code of the version before."""
    assert said(number(1)) == "2.0"
    for written, version in ((0, 5), (1, 7)):
        dies = f"left = [os.replace] * {written}\nos.replace = lambda *a: left.pop()(*a) if left else os._exit(9)"
        number(version, dies).communicate(timeout=60)
        assert said(number(version)) == f"{version + 1}.0"


def test_a_folder_that_cannot_be_written_only_costs_the_cache(
    number: Callable[..., subprocess.Popen[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_LOCATOR_CLASSES", "UserProvidedCacheLocator")
    process = number(1, "print(type(sums.f._cache).__name__)", cache=os.path.join(os.devnull, "cache"))
    assert said(process) == "NullCache\n2.0"


def test_a_full_disk_costs_the_cache_only(number: Callable[..., subprocess.Popen[str]]) -> None:
    full = "def full(*_): raise OSError(28, 'No space left on device')\nos.replace = full"
    assert said(number(1, full)) == "2.0" and said(number(1)) == "2.0"


def test_a_damaged_file_is_compiled_again(number: Callable[..., subprocess.Popen[str]], tmp_path: Path) -> None:
    assert said(number(1)) == "2.0"
    files = [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]
    whole = {path: path.read_bytes() for path in files}
    for left in (0.0, 0.5):
        for path, data in whole.items():
            path.write_bytes(data[: int(left * len(data))])
        assert said(number(1)) == "2.0"
        assert whole and all(len(path.read_bytes()) == len(data) for path, data in whole.items())


def test_several_processes_at_once(number: Callable[..., subprocess.Popen[str]]) -> None:
    """With different variants, on an empty cache; what they leave serves all."""
    kinds = ("float32", "float64", "float32")
    assert [said(process) for process in [number(1, kind=kind) for kind in kinds]] == ["2.0"] * 3
    hits = "import atexit; atexit.register(lambda: print(sum(sums.f.stats.cache_hits.values())))"
    assert [said(number(1, hits, kind)) for kind in kinds] == ["2.0\n1"] * 3
