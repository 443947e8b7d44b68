"""Pointers, stack memory, prefetching and atomics for kernels."""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def data_of(context, builder, kind, value):  # type: ignore[no-untyped-def]
    """The address of an array's elements; a pointer is returned unchanged."""
    return value if isinstance(kind, types.CPointer) else context.make_array(kind)(context, builder, value).data


@intrinsic
def pointer(typingctx, array):  # type: ignore[no-untyped-def]
    """The address of a contiguous array; ``p[i]`` is its i-th element in memory order.

    Kernels convert their arguments to pointers first: passing an array counts references atomically, and indexing one
    handles negative indices. Bounds are not checked.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic(prefer_literal=True)
def scratch(typingctx, kind, size):  # type: ignore[no-untyped-def]
    """A pointer to a constant number of ``kind`` on the stack; LLVM keeps small ones in registers."""
    element = kind.instance_type

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        value = context.get_data_type(element)
        room = cgutils.alloca_once(builder, ir.ArrayType(value, size.literal_value))
        return builder.bitcast(room, value.as_pointer())

    return types.CPointer(element)(kind, size), codegen


@intrinsic
def prefetch(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Prefetches the cache line of ``array[index]``."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = builder.gep(data_of(context, builder, signature.args[0], args[0]), [args[1]])
        byte, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(function, [builder.bitcast(data, byte), *(ir.Constant(i32, v) for v in (0, 3, 1))])
        return context.get_dummy_value()

    return types.none(array, types.intp), codegen


@intrinsic
def fetch_add(typingctx, array, amount):  # type: ignore[no-untyped-def]
    """Atomically adds to ``array[0]`` (int64) and returns its old value."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = data_of(context, builder, signature.args[0], args[0])
        return builder.atomic_rmw("add", data, args[1], "monotonic")

    return types.int64(array, types.int64), codegen
