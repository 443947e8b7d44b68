"""A lock on an output: of two runs that write it, the second would remove the temporaries of the first."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import lock_file


@contextmanager
def output_lock(final: Path, *, of: Path | None = None) -> Iterator[None]:
    """Holds the lock of ``final`` in the body.

    It is that of a hidden file beside ``final``, and ends with the process, however that ends. On a file system without
    locks nothing is locked.

    Args:
        final: in an existing folder; the file itself need not exist.
        of: the name in the error, by default ``final``.

    Raises:
        ClodError: another process holds it.
    """
    from filelock import FileLock, Timeout  # here: --help needs no lock

    path = lock_file(final)
    lock, busy = FileLock(path, timeout=0), "another run is writing it; wait for that, or choose another name"
    try:
        lock.acquire()
    except Timeout as error:
        if not path.exists():  # also raised where no file can be made
            raise ClodError(f"{of or final}: cannot be written; check the path") from error
        raise ClodError(f"{of or final}: {busy}") from error
    except (OSError, NotImplementedError) as error:  # no locks here
        if isinstance(error, PermissionError) and os.path.exists(path):  # the run of another user
            raise ClodError(f"{of or final}: {busy}") from error
        with suppress(OSError):
            path.unlink()
    try:
        yield
    finally:
        if lock.is_locked:
            with suppress(OSError):  # Windows removes no open file; there releasing does
                path.unlink()
            lock.release()
