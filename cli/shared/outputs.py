"""Outputs are compared with all that is read, and with what is there, before any work is done."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import check_target
from clod_adapter.io.scene.files import scene_files

# What a file of ours has in its beginning: PLY comments, the metadata of safetensors and pictures, pages, reports.
OURS = re.compile(rb'clod[-_]adapter|\A\{\s+"command": "')
BEGINNING = 1 << 16  # bytes


def check_outputs(
    outputs: Iterable[Path], inputs: Sequence[str], scene: str | None = None, *, beside: Iterable[Path] = ()
) -> None:
    """Refuses outputs that cannot be written, or whose writing would cost a file that is read or is somebody's.

    Args:
        outputs: those that were named; a file that is there is replaced.
        inputs: the files named to be read.
        scene: the folder of one, of which every file counts (``scene_files``).
        beside: outputs whose names follow from the others: a file that is there is replaced if it is one of ours.

    Raises:
        ClodError: an output is a folder, or no file; is an input by whatever name, hard and symbolic links included;
            or would replace a file that this program has not written.
    """
    outputs, beside = list(outputs), list(beside)
    for path in (*outputs, *beside):
        check_target(path)
        if path.is_dir():
            raise ClodError(f"{path}: is a folder; give the name of a file in it")
        if path.exists() and not path.is_file():
            raise ClodError(f"{path}: is no regular file, and would be replaced by one; choose another output")
    check_no_input([*outputs, *beside], inputs, scene)
    for path in beside:
        check_ours(path)


def check_no_input(outputs: Iterable[Path], inputs: Sequence[str], scene: str | None = None) -> None:
    """Refuses outputs that are an input, whatever the name by which either is reached; see ``check_outputs``."""
    taken = {key: path for path in outputs for key in _keys(path)}
    if not taken:  # nothing is there, so nothing can be lost
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
    """Refuses to replace a file that nobody named and that is none of ours; an empty one is nobody's."""
    if not path.exists():
        return
    with open(path, "rb") as file:
        start = file.read(BEGINNING)
    if start and not OURS.search(start):
        raise ClodError(f"{path}: is there and was not written by clod-adapt; move it, or choose another output")


def _keys(path: Path) -> Iterator[object]:
    """What tells that two names are one file: its place on its device, and the path without links."""
    try:
        found = os.stat(path)
        yield found.st_dev, found.st_ino
        yield os.path.realpath(path)
    except (OSError, ValueError):  # not there, or no name
        return
