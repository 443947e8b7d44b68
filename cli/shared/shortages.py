"""What says that memory or threads ran out, in whichever words: each library has its own error for it."""

from __future__ import annotations

import errno
import sys

from clod_adapter.blocks.memory import in_words
from clod_adapter.errors import ClodError

ADDRESSES = 1_800_000_000  # bytes that the libraries and the smallest run take of a process's address space
# Of RuntimeErrors (torch's allocators, Python's threads) and of ImportErrors (the loader's).
SAYINGS = (
    "can't allocate memory", "not enough memory", "out of memory", "std::bad_alloc", "can't start new thread",
    "failed to map segment", "cannot allocate memory",
)  # fmt: skip
LLVM = "libllvmlite"  # its package says of a library that could not be mapped that it could not be found


def check_addresses() -> None:
    """Refuses a limit of the address space (``ulimit -v``) in which the libraries alone would not fit.

    Some of them abort the process where they cannot map what they need, without a word.
    """
    limit = address_limit()
    if limit is not None and limit < ADDRESSES:
        raise ClodError(
            f"the address space is limited to {in_words(limit)} (ulimit -v), and torch and LLVM alone take "
            f"{in_words(ADDRESSES)}; raise the limit"
        )


def address_limit() -> int | None:
    """Bytes; None where there is no limit."""
    if sys.platform == "win32":
        return None
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def shortage(error: BaseException) -> str | None:
    """A line on what ran out, and what to do, where that is what the error says; None where it is another."""
    text = (str(error) or "allocating").splitlines()[0]
    if isinstance(error, OSError):
        short = error.errno == errno.ENOMEM or (LLVM in text and address_limit() is not None)
    else:
        short = isinstance(error, MemoryError) or any(saying in str(error).lower() for saying in SAYINGS)
    if not short:
        return None
    limit = address_limit()
    more = "free some"
    if limit is not None:
        more = f"raise the limit of {in_words(limit)} on the address space (ulimit -v)"
    return f"there is not enough memory ({text[:200]}); {more}"
