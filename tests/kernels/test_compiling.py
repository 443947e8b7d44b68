"""The cache of compiled kernels, and its failures."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def test_disabled_compilation_is_an_error(capture: Any, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "clod_adapter", str(capture.ply), "--out", str(tmp_path / "dial.ply")]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and os.listdir(tmp_path) == []
    last = done.stderr.splitlines()[-1]
    assert last == "clod-adapt: error: NUMBA_DISABLE_JIT is set, and the kernels run compiled only; unset it"


def test_cache_survives_full_disks_and_processes_killed_while_writing(tmp_path: Path) -> None:
    """A process prints the result of a kernel for ``[1.0]``, 1 + its version, of which the stamp tells."""

    def printed(version: int, before: str = "") -> str:
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
            "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": os.pathsep.join(paths),
        }  # fmt: skip
        done = subprocess.run([sys.executable, "-c", code], env=environment, text=True, stdout=-1, check=False)
        return done.stdout.strip()

    assert printed(1) == "2.0"
    assert printed(5, "os.replace = lambda *a: os._exit(9)") == ""
    assert printed(5, "def full(*_): raise OSError(28, 'No space left on device')\nos.replace = full") == "6.0"
