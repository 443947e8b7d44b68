"""Formats that splat-transform reads, PlayCanvas's converter: through it, where it is installed."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from clod_adapter.errors import ClodError
from clod_adapter.io.foreign import refuse_known
from clod_adapter.io.ply_body import read_element
from clod_adapter.io.ply_columns import sh_degree_of
from clod_adapter.io.ply_header import read_head
from clod_adapter.io.regular import refuse_irregular
from clod_adapter.io.rows import Rows

PROGRAM = "splat-transform"
INSTALL = "npm install -g @playcanvas/splat-transform (with Node 22 or newer)"
LIMIT_S = 1800.0  # five million Gaussians take about a minute


def check_converted(path: Path, version: str = "") -> None:
    """Refuses what is no file, is something else whatever its name, or cannot be converted here.

    Args:
        version: of the format, where only one is read in this way.

    Raises:
        ClodError: it is, or splat-transform is not installed.
    """
    try:
        refuse_irregular(path)
        with open(path, "rb") as file:
            start = file.read(64)
    except (OSError, ValueError) as error:
        raise ClodError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}); check the path") from error
    refuse_known(path, start)
    if shutil.which(PROGRAM) is None:
        raise ClodError(
            f"{path}: {path.suffix}{version} is read through {PROGRAM}, which is not installed: {INSTALL}; better "
            "still, adapt the PLY that it was made from"
        )


def read_converted(path: Path) -> Rows:
    """The Gaussians that splat-transform makes a PLY of.

    Raises:
        ClodError: it is not installed, or cannot read the file.
    """
    check_converted(path)
    with TemporaryDirectory() as folder:
        converted = Path(folder) / "converted.ply"
        run_splat_transform(path, [str(path.resolve()), str(converted)])
        head = read_head(converted)
        degree = sh_degree_of(converted, head.ply)
        vertex = read_element(converted, head)
    note = f"quantised: {path.suffix} stores positions, scales, rotations and colours in a few bits each"
    return Rows(vertex, degree, notes=(note, f"read through {PROGRAM}"), settled=True)


def run_splat_transform(path: Path, arguments: Sequence[str]) -> None:
    """Runs it, quietly; ``path`` is the file that an error is about.

    Raises:
        ClodError: it is not installed, fails, or takes more than LIMIT_S.
    """
    command = [PROGRAM, "--quiet", "--overwrite", *arguments]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=LIMIT_S)
    except FileNotFoundError as error:
        raise ClodError(f"{path}: needs {PROGRAM}, which is not installed: {INSTALL}") from error
    except subprocess.TimeoutExpired as error:
        raise ClodError(f"{path}: {PROGRAM} took more than {LIMIT_S:g} s; give the PLY it was made from") from error
    if done.returncode:
        said = next((line.strip() for line in done.stderr.splitlines() if "rror" in line), f"exit {done.returncode}")
        raise ClodError(f"{path}: {PROGRAM} cannot read it ({said}); copy or export it again")
