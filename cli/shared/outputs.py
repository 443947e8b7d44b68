"""Checks that outputs overwrite no input and no foreign file, before any work is done."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import check_target
from clod_adapter.io.scene.files import scene_files

# Found at the beginning of every file that clod-adapt writes: in PLY comments, metadata, pages and reports.
OURS = re.compile(rb'clod[-_]adapter|\A\{\s+"command": "')
BEGINNING = 1 << 16  # bytes


def check_outputs(
    outputs: Iterable[Path], inputs: Sequence[str], scene: str | None = None, *, beside: Iterable[Path] = ()
) -> None:
    """Refuses outputs that cannot be written, or would replace an input or a foreign file.

    Args:
        outputs: named on the command line; existing files are replaced.
        inputs: files named to be read.
        scene: a scene folder, all of whose files are inputs (``scene_files``).
        beside: outputs with derived names; existing files are replaced if clod-adapt wrote them.

    Raises:
        ClodError: an output is a folder or no regular file; is an input, also by a hard or symbolic link; or would
            replace a file that clod-adapt has not written.
    """
    outputs, beside = list(outputs), list(beside)
    for path in (*outputs, *beside):
        check_target(path)
        if path.is_dir():
            raise ClodError(f"{path}: is a folder; give the name of a file in it")
        if path.exists() and not path.is_file():
            raise ClodError(f"{path}: is no regular file; choose another output")
    check_no_input([*outputs, *beside], inputs, scene)
    for path in beside:
        check_ours(path)


def check_no_input(outputs: Iterable[Path], inputs: Sequence[str], scene: str | None = None) -> None:
    """Refuses outputs that are an input, by any name; see ``check_outputs``."""
    taken = {key: path for path in outputs for key in _keys(path)}
    if not taken:  # no output exists yet
        return
    files = chain(map(Path, inputs), scene_files(Path(scene)) if scene is not None else ())
    for file in files:
        for key in _keys(file):
            if key in taken:
                other = "" if os.path.abspath(file) == os.path.abspath(taken[key]) else f" ({file})"
                raise ClodError(
                    f"{taken[key]}: is an input file{other}, which is never overwritten; choose another output"
                )


def check_ours(path: Path) -> None:
    """Refuses to replace a file that clod-adapt has not written; an empty file may be replaced."""
    if not path.exists():
        return
    with open(path, "rb") as file:
        start = file.read(BEGINNING)
    if start and not OURS.search(start):
        raise ClodError(f"{path}: exists and was not written by clod-adapt; move it, or choose another output")


def _keys(path: Path) -> Iterator[object]:
    """Keys that are equal for two names of one file: device and inode, and the path without links."""
    try:
        found = os.stat(path)
        yield found.st_dev, found.st_ino
        yield os.path.realpath(path)
    except (OSError, ValueError):  # does not exist, or no valid name
        return
