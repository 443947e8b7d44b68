"""Exhausted memory and threads, also at a limit of the shell."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clod_adapter.cli.shared.process import shortage
from clod_adapter.errors import ClodError
from clod_adapter.io.scene import images
from clod_adapter.io.scene.images import read_image

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="limits are those of POSIX")


def limited(kilobytes: int, code: str, *words: object) -> subprocess.CompletedProcess[str]:
    """Runs Python with these arguments; ``limit()`` in ``code`` limits its address space."""
    start = (
        "import resource, sys\nfrom clod_adapter.cli.main import main\n"
        f"def limit(): resource.setrlimit(resource.RLIMIT_AS, ({kilobytes * 1024},) * 2)\n"
    )
    command = [sys.executable, "-c", start + code, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def test_address_space_too_small_for_the_libraries(capture: Any, tmp_path: Path) -> None:
    """Without the check the process hangs, aborts or prints a traceback."""
    words = (capture.ply, "--images", capture.scene, "-o", tmp_path / "dial.ply")
    done = limited(1_200_000, "limit(); sys.exit(main())", *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "clod-adapt: error: the address space is limited to 1.23 GB (ulimit -v), but torch and LLVM need "
        "1.8 GB; raise the limit\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_limit_reached_during_the_work(capture: Any) -> None:
    """torch's allocator raises a RuntimeError."""
    code = (
        "import torch\nfrom clod_adapter.inspection import report\n"
        "def inspect(path): limit(); torch.zeros(1 << 32)\n"
        "report.inspect = inspect\nsys.exit(main())"
    )
    done = limited(8_000_000, code, "inspect", capture.ply)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("clod-adapt: error: not enough memory (") and done.stderr.count("\n") == 1
    assert done.stderr.endswith("); raise the limit of 8.19 GB on the address space (ulimit -v)\n")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 8 TiB"),
        RuntimeError("can't start new thread"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:119] . DefaultCPUAllocator: can't allocate memory: you tried"),
        torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
        OSError(12, "Cannot allocate memory"),
    ],
)
def test_errors_of_a_shortage(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def run(_: object) -> None:
        raise error

    monkeypatch.setattr("clod_adapter.inspection.report.inspect", run)
    done = clod("inspect", capture.ply)
    assert done.code == 2 and done.err.startswith("clod-adapt: error: not enough memory ("), done
    assert done.err.endswith("); free some memory\n")


def test_other_errors() -> None:
    assert shortage(OSError(13, "Permission denied")) is None and shortage(ImportError("no module")) is None
    assert shortage(RuntimeError("an unknown one")) is None


def test_shortage_while_reading_a_photograph_is_not_damage(capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def short(*_: object) -> np.ndarray:
        raise MemoryError("Unable to allocate")

    monkeypatch.setattr(images, "_rgb", short)
    with pytest.raises(MemoryError) as found:
        read_image(capture.scene / "images" / "000.png", 64, 48, 1600)
    assert not isinstance(found.value, ClodError)
