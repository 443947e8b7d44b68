"""How kernels are compiled: without the interpreter lock, inlined where asked, cached on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

# Numba's cache notices a change of the file a function stands in, but not of the constants and
# functions it took from other files. The stamp is therefore of all kernels' sources.
_STAMP = hashlib.sha256(b"".join(p.read_bytes() for p in sorted(Path(__file__).parent.glob("*.py")))).hexdigest()


def kernel(function: Callable[..., Any]) -> Any:
    """A compiled function that Python calls, usually on several threads."""
    dispatcher: Any = njit(nogil=True, cache=True)(function)
    dispatcher._cache._cache_file._source_stamp = _STAMP
    return dispatcher


# Inlined before compilation: a call would pass seven words on the stack for each array argument.
part = njit(nogil=True, inline="always")
