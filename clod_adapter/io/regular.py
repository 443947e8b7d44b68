"""Files that can be read without waiting, and what they begin with."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from clod_adapter.errors import ClodError


def refuse_irregular(path: Path, remedy: str = "give the name of a file") -> None:
    """Raises the ClodError of what is there but no regular file: a pipe would be waited for."""
    if path.exists() and not path.is_file():
        raise ClodError(f"{path}: cannot be read (it is not a regular file); {remedy}")


def read_start(path: Path, size: int = 64) -> bytes:
    """The first bytes of a file, ``size`` of them at most.

    Raises:
        ClodError: it cannot be read, or is no regular file.
    """
    try:
        refuse_irregular(path)
        with open(path, "rb") as file:
            return file.read(size)
    except (OSError, ValueError) as error:  # ValueError: a name that holds a NUL
        raise ClodError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}); check the path") from error


@contextmanager
def utf8_name(path: Path) -> Iterator[str]:
    """A name of the file for libraries that pass names on as UTF-8: its own, or where that is not UTF-8 a handle's."""
    try:
        same = str(path).encode() == os.fsencode(path)
    except UnicodeEncodeError:
        same = False
    if same:
        yield str(path)
    else:
        with open(path, "rb") as held:
            yield f"/dev/fd/{held.fileno()}"
