"""Files that can be read without waiting, and what they begin with."""

from __future__ import annotations

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
