"""How kernels are compiled: without the interpreter lock, inlined where asked, cached on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.extending import intrinsic

# A kernel takes constants and functions from other files, so the stamp is of all kernels' sources.
_STAMP = hashlib.sha256(b"".join(p.read_bytes() for p in sorted(Path(__file__).parent.glob("*.py")))).hexdigest()


# Division by zero gives inf, as in NumPy, and no exception; a * b + c may be fused.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}


def kernel(function: Callable[..., Any]) -> Any:
    """A compiled function that Python calls, usually on several threads."""
    dispatcher: Any = njit(**OPTIONS)(function)
    with suppress(RuntimeError):  # nowhere to write a cache: neither beside the package nor in the user's cache folder
        dispatcher._cache = _Cache(function)
    return dispatcher


class _CacheFile(IndexDataCacheFile):  # type: ignore[misc]
    """Compiled variants, each in a file named by all that its code depends on, which appears whole or not at all.

    Numba's own form is an index beside numbered files, which are used again once the sources have changed, and writes
    the index first. A process that runs between the two writes, or after one that died there, gets the older version's
    code; two that add a variant at once give both the same number; and a file that was cut stays an error for good.
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


# Always inlined: a call would pass seven words on the stack for each array argument.
part = njit(forceinline=True, **OPTIONS)


@intrinsic
def pointer(typingctx, array):  # type: ignore[no-untyped-def]
    """Where a contiguous array's elements lie; ``p[i]`` is the i-th of all of them.

    Kernels turn their arguments into pointers first: passing an array on counts references atomically,
    and indexing one looks for negative indices. Nothing checks the bounds.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic(prefer_literal=True)
def scratch(typingctx, kind, size):  # type: ignore[no-untyped-def]
    """A pointer to a constant number of ``kind`` on the stack: LLVM keeps a few in registers where it can."""
    element = kind.instance_type

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        value = context.get_data_type(element)
        room = cgutils.alloca_once(builder, ir.ArrayType(value, size.literal_value))
        return builder.bitcast(room, value.as_pointer())

    return types.CPointer(element)(kind, size), codegen
