"""Sets of blocks and of lanes as bits of a uint64."""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from clod_adapter._kernels.simd import INTEGERS, LANES, call_llvm, f32x16, mask16, operation


@operation(types.uint64, mask16)
def bits_of(builder, mask):  # type: ignore[no-untyped-def]
    """The mask as the low sixteen bits of a uint64."""
    return builder.zext(builder.bitcast(mask, ir.IntType(LANES)), ir.IntType(64))


@intrinsic(prefer_literal=True)
def set_spans(typingctx, words, index, low, high, quarter):  # type: ignore[no-untyped-def]
    """In the r-th of ``quarter`` groups of ``quarter`` bits from ``words[index]`` on, sets bits low[r] to high[r].

    Both are rounded towards zero; where high < low no bit is set. ``quarter`` is 8 or 16, words are uint64.
    """
    rows = quarter.literal_value

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        low, high = (builder.fptosi(x, INTEGERS) for x in args[2:4])
        ones = ir.Constant(INTEGERS, [1] * LANES)
        bits = builder.sub(builder.shl(ir.Constant(INTEGERS, [2] * LANES), high), builder.shl(ones, low))
        bits = builder.select(builder.icmp_signed(">=", high, low), bits, ir.Constant(INTEGERS, [0] * LANES))
        narrow = builder.trunc(bits, ir.VectorType(ir.IntType(rows), LANES))
        first = ir.Constant(ir.VectorType(ir.IntType(32), rows), list(range(rows)))
        narrow = builder.shuffle_vector(narrow, narrow, first)
        data = builder.gep(args[0], [args[1]])
        builder.store(narrow, builder.bitcast(data, narrow.type.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.none(words, types.intp, f32x16, f32x16, quarter), codegen


@operation(types.int64, types.uint64)
def lowest(builder, bits):  # type: ignore[no-untyped-def]
    """Index of the lowest bit that is set in a uint64 other than 0."""
    return call_llvm(builder, "llvm.cttz.i64", bits.type, [bits, ir.Constant(ir.IntType(1), 1)])


@operation(types.int64, types.uint64)
def ones(builder, bits):  # type: ignore[no-untyped-def]
    """How many bits of a uint64 are set."""
    return call_llvm(builder, "llvm.ctpop.i64", bits.type, [bits])
