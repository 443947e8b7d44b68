"""A lock on an output: of two runs that write it, the second would remove the temporaries of the first."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import lock_file

if sys.platform != "win32":
    import fcntl

TRIES = 100  # where the last holder removes the file meanwhile
NOT_HERE = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)  # a file system without locks


@contextmanager
def output_lock(final: Path, *, of: Path | None = None, shared: bool = False) -> Iterator[None]:
    """Holds the lock of ``final`` in the body.

    It is that of a hidden file beside ``final`` (``flock``), and ends with the process, however that ends. On a file
    system without locks, and on Windows, nothing is locked.

    Args:
        final: in an existing folder; the file itself need not exist.
        of: the name in the error, by default ``final``.
        shared: with other shared holders, as the jobs of one run are.

    Raises:
        ClodError: another process holds it.
    """
    if sys.platform == "win32":
        yield
        return
    path, name = lock_file(final), of or final
    handle = _locked(path, name, shared)
    try:
        yield
    finally:
        if handle is not None:
            with suppress(OSError):  # other holders: the last one removes the file
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
            os.close(handle)


def _locked(path: Path, name: Path, shared: bool) -> int | None:
    """The handle that holds the lock; None where there are no locks."""
    for _ in range(TRIES):
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.read(handle, 20).decode("ascii", "replace")
            os.close(handle)
            if error.errno in NOT_HERE:
                with suppress(OSError):
                    path.unlink()
                return None
            if not isinstance(error, BlockingIOError):
                raise
            which = f" (process {holder})" if holder else ""
            raise ClodError(
                f"{name}: another run{which} is writing it; wait for that, or choose another name"
            ) from error
        if _is_still(path, handle):
            with suppress(OSError):  # a full disk; then the error of a second run does not name this one
                os.truncate(handle, 0)
                os.pwrite(handle, str(os.getpid()).encode(), 0)
            return handle
        os.close(handle)
    raise ClodError(f"{name}: other runs keep writing it; choose another name")


def _is_still(path: Path, handle: int) -> bool:
    """Whether the path still names the locked file."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.stat(path), os.fstat(handle))
    return False
