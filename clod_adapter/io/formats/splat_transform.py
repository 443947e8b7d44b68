"""Finds and runs splat-transform, PlayCanvas's converter of splat files: an optional tool that needs Node.

It compresses to SOG and to compressed PLY, makes streaming sets of several levels, merges Gaussians, and reads what
this package does not read itself.
"""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import read_start, read_whole, refuse_known

if TYPE_CHECKING:
    from clod_adapter.io.settings import Source

VARIABLE = "CLOD_SPLAT_TRANSFORM"
NEEDED, NODE_NEEDED = (3, 7), 22
INSTALL = "npm install node@22 @playcanvas/splat-transform@3.7"
HELP = (
    f"in a folder of its own: {INSTALL}; then PATH=FOLDER/node_modules/node/bin:FOLDER/node_modules/.bin:$PATH, or the "
    f"command in {VARIABLE}"
)
ASKING = 30.0  # seconds that a question about itself may take
LIMIT, LIMIT_EACH = 600.0, 0.02  # seconds for a run, and per Gaussian; ten times what was measured
LIMIT_CONVERT = 1800.0  # seconds; five million Gaussians take about a minute
TICK = 0.2  # seconds between two checks for its end
# Without a GPU, where a round of SOG's clustering of spherical harmonics takes minutes, and its usual ten take an hour.
# Two rounds more give 0.02 dB.
ON_CPU = ("-g", "cpu", "-i", "1")
# Prints the version of the Node that runs the tool, also if a wrapper or a symbolic link starts it.
_SAY_NODE = "--import=data:text/javascript,process.stderr.write(`node:${process.version};`)"
LEAVES, SMALLEST = 128, 8  # fewest leaves of a large set, and thousands (1,024) of Gaussians below which none is cut


def cutting_options(count: int) -> tuple[str, ...]:
    """Options for the leaves of a streaming set of ``count`` Gaussians over all levels, in any unit of length.

    By default the tool cuts what is wider than 16 units, which suits a scene in metres only.
    """
    return "--lod-chunk-extent", "0", "--lod-chunk-min", str(max(SMALLEST, count // (1024 * LEAVES)))


@dataclass(frozen=True)
class SplatTransform:
    """The tool as it is here.

    Attributes:
        command: how it is started.
        version: of the tool, three numbers.
        gpu: whether it sees a GPU; without one it clusters spherical harmonics on the CPU, in one round.
    """

    command: tuple[str, ...]
    version: str
    gpu: bool = False

    @classmethod
    def find(cls) -> SplatTransform:
        """The one in the environment's ``CLOD_SPLAT_TRANSFORM``, a command with its words, or on the PATH.

        Raises:
            ClodError: it is not there, it or its Node is too old, or it does not run; with the install line.
        """
        given = os.environ.get(VARIABLE, "")
        name, *more = _words(given) or ("splat-transform",)
        program = shutil.which(name)
        if program is None:
            where = f"{name}, which {VARIABLE} names, is" if given else "splat-transform is"
            raise ClodError(f"{where} not installed; {HELP}")
        command = (program, *more)
        output = _ask(command, "--version")
        version, node = re.search(r"splat-transform v(\d+)\.(\d+)\.(\d+)", output), re.search(r"node:v(\d+)", output)
        if node is not None and int(node[1]) < NODE_NEEDED:
            raise ClodError(f"splat-transform is run by Node {node[1]} and needs {NODE_NEEDED} or newer; {HELP}")
        if version is None:
            raise ClodError(f"{shlex.join(command)} does not run as splat-transform; {HELP}")
        found = tuple(map(int, version.groups()))
        if found[:2] < NEEDED:
            wanted = ".".join(map(str, NEEDED))
            raise ClodError(f"splat-transform is {'.'.join(version.groups())}, {wanted} or newer is needed; {HELP}")
        gpu = re.search(r"(?m)^\s*\[\d+\] \S", _ask(command, "--list-gpus")) is not None
        return cls(command, ".".join(version.groups()), gpu)

    def run(self, *words: str | Path, timeout: float, progress: Callable[[float], None] | None = None) -> float:
        """Runs it with these words, replacing outputs; the seconds it took.

        A Path is made absolute, so that it is read neither as an option nor as an address. Ctrl-C and every other
        exception raised here end the tool.

        Args:
            timeout: seconds after which it is ended.
            progress: called now and then with the seconds so far.

        Raises:
            ClodError: it fails, with the last line of its output, or takes longer than that.
        """
        command = [*self.command, "-w", *(() if self.gpu else ON_CPU), *map(_word, words)]
        began = time.perf_counter()
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            encoding="utf-8", errors="replace",
        )  # fmt: skip
        try:
            output = None
            while output is None:
                taken = time.perf_counter() - began
                if taken > timeout:
                    raise ClodError(f"splat-transform was ended, it took longer than {timeout:.0f} s")
                if progress:
                    progress(taken)
                with suppress(subprocess.TimeoutExpired):
                    output, _ = process.communicate(timeout=TICK)
        except BaseException:
            process.kill()
            process.communicate()
            raise
        if process.returncode:
            raise ClodError(f"splat-transform {self.version} failed: {_reason(output)}")
        return time.perf_counter() - began


def time_limit(count: int) -> float:
    """Seconds after which a run over this many Gaussians has hung."""
    return LIMIT + LIMIT_EACH * count


def check_converted(path: Path, version: str = "") -> SplatTransform:
    """The converter; refuses a file that is something else, or that cannot be converted here.

    Args:
        version: of the format, where only one version is read in this way.
    """
    refuse_known(path, read_start(path))
    try:
        return SplatTransform.find()
    except ClodError as error:
        raise ClodError(
            f"{path}: {path.suffix}{version} is read through splat-transform ({error}); better still, adapt the PLY "
            "that it was made from"
        ) from error


def load_converted(path: Path, version: str = "") -> Source:
    """The Gaussians of the PLY that splat-transform converts the file to; ``version`` as in ``check_converted``."""
    from clod_adapter.io.ply import read_ply  # here: check_converted needs neither plyfile nor numpy
    from clod_adapter.io.settings import Metadata, Source

    tool, sha256 = check_converted(path, version), hashlib.sha256(read_whole(path)).hexdigest()
    with TemporaryDirectory() as folder:
        converted = Path(folder) / "converted.ply"
        try:
            tool.run(path, converted, timeout=LIMIT_CONVERT)
        except ClodError as error:
            raise ClodError(f"{path}: cannot be read ({error}); copy or export it again") from error
        arrays = read_ply(converted).arrays
    note = f"quantised: {path.suffix} stores positions, scales, rotations and colours in a few bits each"
    return Source(arrays, Metadata(), sha256, (note, f"read through splat-transform {tool.version}"))


def _words(given: str) -> tuple[str, ...]:
    """The words of a command; a path with spaces in it that is there needs no quotes."""
    if not given or shutil.which(given):
        return (given,) if given else ()
    try:
        return tuple(shlex.split(given))
    except ValueError as error:
        raise ClodError(f"{VARIABLE} is {given!r}, which is no command ({error}); {HELP}") from error


def _word(word: str | Path) -> str:
    return str(word.absolute()) if isinstance(word, Path) else word


def _ask(command: tuple[str, ...], question: str) -> str:
    """Its output for an option that asks about it; empty where it does not run."""
    options = f"{os.environ.get('NODE_OPTIONS', '')} {_SAY_NODE}".strip()
    try:
        done = subprocess.run(
            [*command, question], stdin=subprocess.DEVNULL, capture_output=True, text=True, encoding="utf-8",
            errors="replace", timeout=ASKING, env={**os.environ, "NODE_OPTIONS": options},
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return f"{done.stderr}\n{done.stdout}"


def _reason(output: str) -> str:
    """The line with the error, or the last one; without the stack trace and the duration."""
    lines = [line.strip(" \t✗·▸") for line in output.splitlines()]
    lines = [line for line in lines if line and not line.startswith(("at ", "failed in "))]
    errors = [line for line in lines if "Error" in line]
    return (errors or lines or ["no output"])[-1]
