"""Threads of kernels and files, recycled memory, the cache of compiled kernels, and their
failures.
"""

import gc
import os
import subprocess
import sys
import threading
import time
from functools import partial

import numpy as np
import pytest
import torch
from common import ROOT

from clod_adapter._kernels import threads
from clod_adapter._kernels.memory import IDLE, recycled, release
from clod_adapter._support.workers import in_order, shared


def test_disabled_compilation_is_an_error(capture, tmp_path):
    command = [
        sys.executable,
        "-m",
        "clod_adapter",
        str(capture.ply),
        "--out",
        str(tmp_path / "dial.ply"),
    ]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and os.listdir(tmp_path) == []
    last = done.stderr.splitlines()[-1]
    assert (
        last == "clod-adapt: error: NUMBA_DISABLE_JIT is set, and the kernels run compiled only;"
        " unset it"
    )


def test_cache_survives_full_disks_and_processes_killed_while_writing(tmp_path):
    """A process prints the result of a kernel for ``[1.0]``, 1 + its version, of which the stamp
    tells.
    """

    def printed(version, before=""):
        (tmp_path / "sums.py").write_text(
            "from clod_adapter._kernels import compiling\n"
            f"VERSION, compiling._STAMP = {version}.0, '{version}'\n"
            "@compiling.kernel\n"
            "def f(x):\n"
            "    return x[0] + VERSION\n"
        )
        os.utime(tmp_path / "sums.py", (0, 0))  # Numba's own stamp of the file
        code = f"import sums, os, numpy\n{before}\nprint(sums.f(numpy.ones(1)))"
        paths = map(str, (tmp_path, os.environ.get("PYTHONPATH", ""), ROOT))
        environment = os.environ | {
            "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": os.pathsep.join(paths),
        }
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, text=True, stdout=-1, check=False
        )
        return done.stdout.strip()

    assert printed(1) == "2.0"
    assert printed(5, "os.replace = lambda *a: os._exit(9)") == ""
    assert (
        printed(5, "def full(*_): raise OSError(28, 'No space left on device')\nos.replace = full")
        == "6.0"
    )


SHAPE = (120, 160, 3)
HOLDERS = {
    "slice": lambda t: t[5:, 3],
    "storage": lambda t: t.untyped_storage(),
    "numpy view of a view": lambda t: t[7:].numpy()[1:].reshape(-1)[5:],
    "other type": lambda t: t.numpy().reshape(-1).view(np.uint64)[2:],
    "dlpack": lambda t: torch.from_dlpack(t),
    "graph": lambda t: t.clone().requires_grad_() * t,
}


@pytest.fixture(autouse=True)
def nothing_idle():
    release()
    yield
    release()


@pytest.mark.parametrize("holder", HOLDERS)
def test_held_memory_is_not_used_again(holder):
    tensor = recycled(SHAPE).fill_(7)
    first, end = tensor.data_ptr(), tensor.data_ptr() + 4 * tensor.numel()
    held = HOLDERS[holder](tensor)
    del tensor
    others = [recycled(SHAPE) for _ in range(IDLE)]
    assert all(
        other.data_ptr() >= end or other.data_ptr() + 4 * other.numel() <= first for other in others
    )
    del held
    gc.collect()
    assert recycled(SHAPE).data_ptr() == first  # and then it is
    before = {other.data_ptr() for other in others} | {first}
    others.clear()
    assert {recycled(SHAPE).data_ptr() for _ in range(IDLE)} <= before


def test_an_error_is_raised_after_started_calls_end():
    done, asked = [], []

    def call(number):
        if number == 1:
            raise ValueError("one")
        time.sleep(0.05)
        done.append(number)

    with pytest.raises(ValueError, match="one"):
        list(in_order((asked.append(k) or partial(call, k) for k in range(100)), 2))
    assert set(done) <= set(asked) - {1} and len(asked) < 10
    count = len(done)
    time.sleep(0.1)
    assert len(done) == count


def test_kernels_run_again_after_threads_were_refused(monkeypatch):
    def kernel(worker, count, out):
        out[worker] = count

    def refuse(_):
        raise RuntimeError("can't start new thread")

    shared.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        for run in (
            lambda: threads.run(kernel, 3, torch.zeros(3)),
            lambda: list(in_order([int], 2)),
        ):
            with pytest.raises(MemoryError, match="a thread cannot be started: too little memory"):
                run()
    threads.run(kernel, 3, out := torch.zeros(3))
    assert out.tolist() == [3, 3, 3]
