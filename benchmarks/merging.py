"""Merging, the training-free rival: ``splat-transform --decimate`` (NanoGS's pairwise merging), its files cached."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from plyfile import PlyData, PlyElement

import clod_adapter as clod

INSTALL = "npm install node@22 @playcanvas/splat-transform@3.7"
HELP = (
    f"splat-transform needs Node 22 or newer. In a folder of its own: {INSTALL}; then "
    "PATH=FOLDER/node_modules/node/bin:FOLDER/node_modules/.bin:$PATH, or the command in SPLAT_TRANSFORM"
)


@dataclass(frozen=True)
class Merger:
    """The tool, and the folder that keeps what it made.

    Attributes:
        command: how it is started.
        version: of the tool; files of another version are not taken for its own.
        cache: the folder, made when needed.
    """

    command: tuple[str, ...]
    version: str
    cache: Path

    @classmethod
    def find(cls, cache: Path) -> Merger:
        """From ``SPLAT_TRANSFORM`` or the PATH; leaves with the install line where it is missing or too old."""
        command = tuple(shlex.split(os.environ.get("SPLAT_TRANSFORM", "splat-transform")))
        if not command or shutil.which(command[0]) is None:
            sys.exit(f"splat-transform is not on the PATH. {HELP}")
        said = subprocess.run([*command, "--version"], capture_output=True, text=True)
        found = re.search(r"v(\d+)\.(\d+)\.(\d+)", said.stdout + said.stderr)
        if found is None or int(found[1]) < 3:  # 2.7 takes minutes for what takes 3 seconds
            sys.exit(f"{shlex.join(command)} is no splat-transform 3 that runs. {HELP}")
        return cls(command, ".".join(found.groups()), cache)

    def merge(self, base: clod.Checkpoint, count: int) -> tuple[clod.Gaussians, float]:
        """The base merged to ``count`` Gaussians, and the seconds that the tool took, then or now."""
        self.cache.mkdir(parents=True, exist_ok=True)
        out = self.cache / f"{base.fingerprint[:12]}-{self.version}-{count}.ply"
        clock = out.with_suffix(".seconds")
        if not (out.exists() and clock.exists()):
            # In a folder of its own: another benchmark may want the same file now.
            with tempfile.TemporaryDirectory(dir=self.cache) as folder:
                seconds = self._run(base, count, Path(folder))
                clock.write_text(f"{seconds:.2f}\n", encoding="utf-8")
                (Path(folder) / "merged.ply").replace(out)
        return clod.load(out).gaussians, float(clock.read_text(encoding="utf-8"))

    def _run(self, base: clod.Checkpoint, count: int, folder: Path) -> float:
        """Writes ``merged.ply`` into the folder; the seconds it took."""
        source, merged = folder / "base.ply", folder / "merged.ply"
        _write_plain(source, base)
        began = time.perf_counter()
        command = [*self.command, "-q", "-w", "-g", "cpu", str(source), "--decimate", str(count), str(merged)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode or not merged.exists():
            sys.exit(f"{shlex.join(command)} failed: {(done.stderr or done.stdout).strip()}")
        return time.perf_counter() - began


def _write_plain(path: Path, base: clod.Checkpoint) -> None:
    """The rows that the reader used, without MaskGaussian's columns, whose averages would mean nothing."""
    names = [name for name in base.vertex.dtype.names if not name.startswith("masks_")]
    plain = base.vertex[names].astype([(name, base.vertex.dtype[name]) for name in names])  # a view keeps the gaps
    PlyData([PlyElement.describe(plain, "vertex")]).write(path)
