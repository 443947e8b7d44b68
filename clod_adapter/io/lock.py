"""A lock on an output: of two runs that write it, the second would remove the temporaries of the first."""

from __future__ import annotations

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
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise ClodError(f"{of or final}: another run is writing it; wait for that, or choose another name") from error
    except (OSError, NotImplementedError):  # no locks here
        with suppress(OSError):
            path.unlink()
    try:
        yield
    finally:
        if lock.is_locked:
            with suppress(OSError):  # Windows removes no open file; there releasing does
                path.unlink()
            lock.release()
