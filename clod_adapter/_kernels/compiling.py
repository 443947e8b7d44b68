"""Compilation of kernels: without the interpreter lock, with inlining, cached on disk."""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba import config, njit
from numba.core.caching import FunctionCache, IndexDataCacheFile

from clod_adapter.errors import ClodError

if config.DISABLE_JIT:  # type: ignore[attr-defined]
    raise ClodError("NUMBA_DISABLE_JIT is set, and the kernels run compiled only; unset it")

# A kernel uses constants and functions of other files, so the stamp covers the sources of all
# kernels.
_STAMP = hashlib.sha256(
    b"".join(p.read_bytes() for p in sorted(Path(__file__).parent.glob("*.py")))
).hexdigest()


# Division by zero gives inf, as in NumPy, and no exception; a * b + c may be fused.
OPTIONS: Any = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract"},
    "no_cfunc_wrapper": True,
}


def kernel(function: Callable[..., Any]) -> Any:
    """A compiled function that Python calls, usually on several threads."""
    dispatcher: Any = njit(**OPTIONS)(function)
    with suppress(RuntimeError):  # no writable cache folder
        dispatcher._cache = _Cache(function)
    return dispatcher


class _CacheFile(IndexDataCacheFile):  # type: ignore[misc]
    """Compiled variants, each in a file named by a hash of all that its code depends on and written
    atomically.

    Numba's own writes an index and then a numbered file: in between other processes load old code,
    two processes may choose the same number, and a truncated file stays an error.
    """

    def _name(self, key: Any) -> str:
        digest = hashlib.sha256(repr((self._version, self._source_stamp, key)).encode()).hexdigest()
        return self._data_name_pattern.format(number=int(digest[:16], 16))

    def load(self, key: Any) -> Any:
        with suppress(Exception):  # absent, or damaged: unpickling raises many kinds
            return self._load_data(self._name(key))

    def save(self, key: Any, data: Any) -> None:
        self._save_data(self._name(key), data)


class _Cache(FunctionCache):  # type: ignore[misc]
    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _CacheFile(self._cache_path, self._impl.filename_base, _STAMP)

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):  # a full disk costs the cache, not the run
            super().save_overload(sig, data)


inlined = njit(forceinline=True, no_cpython_wrapper=True, **OPTIONS)  # type: ignore[call-overload]
