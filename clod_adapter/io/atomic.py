"""Outputs appear whole or not at all: write under a temporary name, then rename."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from clod_adapter.errors import ClodError


@contextmanager
def atomic_path(final: str | Path) -> Iterator[Path]:
    """Gives a temporary name beside ``final``; on success what was written there takes its place.

    The body writes a file, or makes a folder, at the yielded path, which does not exist yet. It is
    flushed to disk before it is renamed, so a crash leaves either the old ``final`` or the new one.
    On any exception (KeyboardInterrupt too) the temporary is removed and ``final`` is untouched.

    Raises:
        ClodError: the folder is missing or not writable, ``final`` is a folder that is not empty, or
            the operating system refuses the write (a full disk, say).
    """
    final = Path(final)
    check_target(final)
    # The suffix is kept because some writers choose their format by it.
    temporary = final.parent / f".tmp-{uuid.uuid4().hex}{final.suffix}"
    try:
        yield temporary
        for path in [*temporary.rglob("*"), temporary]:
            _flush(path)
        os.replace(temporary, final)
        with suppress(OSError):  # the file is in place; some file systems cannot flush a folder
            _flush(final.parent)
    except OSError as error:
        raise ClodError(f"{final}: cannot be written: {error.strerror or error}") from error
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)


def check_target(final: Path) -> None:
    """Raises the ClodError that ``atomic_path`` would, as far as can be told before anything is written."""
    folder = final.parent
    if not folder.is_dir():
        raise ClodError(f"{final}: folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ClodError(f"{final}: folder {folder} is not writable; choose another or change its permissions")
    if final.is_dir() and any(final.iterdir()):
        raise ClodError(f"{final}: is a folder that is not empty; choose another name")


def _flush(path: Path) -> None:
    if path.is_dir() and os.name == "nt":  # Windows cannot open a folder
        return
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
