"""Finds and runs splat-transform, PlayCanvas's converter of splat files: an optional tool that
needs Node.

It writes glTF, SOG, compressed PLY and streaming sets, merges Gaussians, and reads what is not read
here.
"""

from __future__ import annotations

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
from typing import TYPE_CHECKING, Any

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import START, read_bytes, reject_known

if TYPE_CHECKING:
    from clod_adapter.io.settings import Source

VARIABLE = "CLOD_SPLAT_TRANSFORM"
NEEDED = (3, 7)
INSTALL = "npm install node@22 @playcanvas/splat-transform@3.7"
_PATH = "PATH=FOLDER/node_modules/node/bin:FOLDER/node_modules/.bin:$PATH"
HELP = f"in a folder of its own: {INSTALL}; then {_PATH}, or the command in {VARIABLE}"
ASKING = 30.0  # seconds that a question about itself may take
# Ten times what was measured.
LIMIT = 600.0  # seconds after which a run has hung
LIMIT_EACH = 0.02  # seconds more for each Gaussian
LIMIT_CONVERT = 1800.0  # seconds; five million Gaussians take about a minute
TICK = 0.2  # seconds between two checks for its end
# Without a GPU, where a round of SOG's clustering of spherical harmonics takes minutes, and its
# usual ten take an hour. Two rounds more give 0.02 dB.
ON_CPU = ("-g", "cpu", "-i", "1")
_TEXT: dict[str, Any] = {
    "stdin": subprocess.DEVNULL,
    "stdout": subprocess.PIPE,
    "stderr": subprocess.STDOUT,
    "encoding": "utf-8",
    "errors": "replace",
}
LEAVES = 128  # fewest of a large set
SMALLEST = 8  # thousands (1,024) of Gaussians below which a leaf is not cut


def cutting_options(count: int) -> tuple[str, ...]:
    """Options for the leaves of a streaming set; by default the tool cuts what is wider than 16
    units of length.
    """
    least = max(SMALLEST, count // (1024 * LEAVES))
    return ("--lod-chunk-extent", "0", "--lod-chunk-min", str(least))


@dataclass(frozen=True)
class SplatTransform:
    """The tool as it is here."""

    command: tuple[str, ...]  # how it is started
    version: str  # three numbers
    # whether it sees one; else it clusters spherical harmonics on the CPU, in one round
    gpu: bool = False

    @classmethod
    def find(cls) -> SplatTransform:
        """The one in the environment's ``CLOD_SPLAT_TRANSFORM``, a command with its words, or on
        the PATH.
        """
        setting = os.environ.get(VARIABLE, "")
        try:  # a path with spaces in it that is there needs no quotes
            name, *options = (
                [setting]
                if setting and shutil.which(setting)
                else shlex.split(setting) or ["splat-transform"]
            )
        except ValueError as error:
            raise ClodError(
                f"{VARIABLE} is {setting!r}, which is no command ({error}); {HELP}"
            ) from error
        program = shutil.which(name)
        if program is None:
            where = f"{name}, which {VARIABLE} names, is" if setting else "splat-transform is"
            raise ClodError(f"{where} not installed; {HELP}")
        command = (program, *options)
        version = re.search(r"splat-transform v((\d+)\.(\d+)\.\d+)", _ask(command, "--version"))
        if version is None:
            raise ClodError(
                f"{shlex.join(command)} does not run as splat-transform; it needs Node 22; {HELP}"
            )
        if (int(version[2]), int(version[3])) < NEEDED:
            raise ClodError(
                f"splat-transform is {version[1]}, {'.'.join(map(str, NEEDED))} or newer is needed;"
                f" {HELP}"
            )
        gpu = re.search(r"(?m)^\s*\[\d+\] \S", _ask(command, "--list-gpus")) is not None
        return cls(command, version[1], gpu)

    def run(
        self, *words: str | Path, timeout: float, progress: Callable[[float], None] | None = None
    ) -> float:
        """Runs it with these words, replacing outputs; the seconds it took. An exception, as of
        Ctrl-C, ends the tool.

        A Path is made absolute, to be no option and no address. ``progress`` is called with the
        seconds so far.
        """
        words_as_text = [str(word.absolute()) if isinstance(word, Path) else word for word in words]
        began = time.perf_counter()
        process = subprocess.Popen(
            [*self.command, "-w", *(() if self.gpu else ON_CPU), *words_as_text], **_TEXT
        )
        try:
            output = None
            while output is None:
                seconds = time.perf_counter() - began
                if seconds > timeout:
                    raise ClodError(
                        f"splat-transform was ended, it took longer than {timeout:.0f} s"
                    )
                if progress:
                    progress(seconds)
                with suppress(subprocess.TimeoutExpired):
                    output, _ = process.communicate(timeout=TICK)
        except BaseException:
            process.kill()
            process.communicate()
            raise
        # the line with the error, or the last one; without the stack trace and the duration
        if process.returncode:
            lines = [line.strip(" \t✗·▸") for line in output.splitlines()]
            lines = [line for line in lines if line and not line.startswith(("at ", "failed in "))]
            reason = ([line for line in lines if "Error" in line] or lines or ["no output"])[-1]
            raise ClodError(f"splat-transform {self.version} failed: {reason}")
        return time.perf_counter() - began


def check(path: Path) -> SplatTransform:
    """The converter; rejects what cannot be converted here."""
    reject_known(path, read_bytes(path, START))
    try:
        return SplatTransform.find()
    except ClodError as error:
        kind = "SPZ of another version than 3" if path.suffix.lower() == ".spz" else "this format"
        raise ClodError(
            f"{path}: {kind} is read through splat-transform ({error}); better still, adapt the"
            " PLY that it was made from"
        ) from error


def read(path: Path, _: bytes) -> Source:
    """The Gaussians of the PLY that splat-transform converts the file to."""
    from clod_adapter.io import ply  # here: check needs neither plyfile nor numpy
    from clod_adapter.io.settings import Metadata, Source

    tool = check(path)
    with TemporaryDirectory() as folder:
        converted = Path(folder) / "converted.ply"
        try:
            tool.run(path, converted, timeout=LIMIT_CONVERT)
        except ClodError as error:
            raise ClodError(f"{path}: cannot be read ({error}); copy or export it again") from error
        arrays = ply.read(converted, read_bytes(converted)).arrays
    note = "quantised: the file stores positions, scales, rotations and colours in a few bits each"
    return Source(arrays, Metadata(), (note, f"read through splat-transform {tool.version}"))


def _ask(command: tuple[str, ...], question: str) -> str:
    """Its output for an option that asks about it; empty where it does not run."""
    with suppress(OSError, subprocess.TimeoutExpired):
        return str(subprocess.run([*command, question], **_TEXT, timeout=ASKING).stdout)
    return ""
