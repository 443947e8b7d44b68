"""Surroundings in which the libraries cannot work, and their errors for exhausted memory or threads."""

from __future__ import annotations

import errno
import os
import sys

from clod_adapter.blocks.memory import in_words
from clod_adapter.errors import ClodError

ADDRESSES = 1_800_000_000  # bytes of address space that the libraries and the smallest run need
# In RuntimeErrors (torch's allocators, Python's threads) and ImportErrors (the loader's).
MESSAGES = (
    "can't allocate memory", "not enough memory", "out of memory", "std::bad_alloc", "can't start new thread",
    "failed to map segment", "cannot allocate memory",
)  # fmt: skip
LLVM = "libllvmlite"  # reported as not found where it could not be mapped


def check_surroundings() -> None:
    """Refuses what makes libraries abort the process, or raise an error of their own.

    That is a current folder that was deleted, and a limit of the address space (``ulimit -v``) that is too small.
    Variables of what is not used here, numba's threads and matplotlib's windows, are removed.
    """
    for name in ("NUMBA_NUM_THREADS", "MPLBACKEND"):
        os.environ.pop(name, None)
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise ClodError("the current folder was deleted; change to another one") from error
    limit = address_limit()
    if limit is not None and limit < ADDRESSES:
        raise ClodError(
            f"the address space is limited to {in_words(limit)} (ulimit -v), but torch and LLVM need "
            f"{in_words(ADDRESSES)}; raise the limit"
        )


def address_limit() -> int | None:
    """The limit in bytes; None without one."""
    if sys.platform == "win32":
        return None
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def shortage(error: BaseException) -> str | None:
    """The shortage and its remedy in one line; None for another error."""
    text = (str(error) or "allocating").splitlines()[0]
    if isinstance(error, OSError):
        short = error.errno == errno.ENOMEM or (LLVM in text and address_limit() is not None)
    else:
        short = isinstance(error, MemoryError) or any(message in str(error).lower() for message in MESSAGES)
    if not short:
        return None
    limit = address_limit()
    more = "free some memory"
    if limit is not None:
        more = f"raise the limit of {in_words(limit)} on the address space (ulimit -v)"
    return f"not enough memory ({text[:200]}); {more}"
