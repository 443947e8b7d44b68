"""How kernels are compiled: without the interpreter lock, inlined where asked, cached on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

# Numba's cache notices a change of the file a function stands in, but not of the constants and
# functions it took from other files. The stamp is therefore of all kernels' sources.
_STAMP = hashlib.sha256(b"".join(p.read_bytes() for p in sorted(Path(__file__).parent.glob("*.py")))).hexdigest()


# Division by zero gives inf, as in NumPy, and no exception; a * b + c may be fused.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}


def kernel(function: Callable[..., Any]) -> Any:
    """A compiled function that Python calls, usually on several threads."""
    try:
        dispatcher: Any = njit(cache=True, **OPTIONS)(function)
    except RuntimeError:  # nowhere to write a cache: neither beside the package nor in the user's cache folder
        return njit(**OPTIONS)(function)
    dispatcher._cache._cache_file._source_stamp = _STAMP
    return dispatcher


# Inlined before compilation: a call would pass seven words on the stack for each array argument.
part = njit(inline="always", **OPTIONS)


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
