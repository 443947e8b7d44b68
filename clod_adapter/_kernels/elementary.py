"""Elementary functions of sixteen-lane vectors, and sets of blocks and of lanes as bits of a
uint64.
"""

import math

from llvmlite import ir
from numba import types

from clod_adapter._kernels.simd import (
    INTEGERS,
    LANES,
    VECTOR,
    call_llvm,
    f32x16,
    llvm_function,
    mask16,
    operation,
)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(VECTOR if isinstance(value, float) else INTEGERS, [value] * LANES)


def _fma(builder, *factors_and_summand):
    return call_llvm(builder, "llvm.fmuladd.v16f32", VECTOR, factors_and_summand)


vsqrt = llvm_function("sqrt", 1)
vabs = llvm_function("fabs", 1)
vfloor = llvm_function("floor", 1)
vceil = llvm_function("ceil", 1)


# Minimax polynomial of 2^f on [-0.5, 0.5] with p(0) = 1: relative error 9e-8, in float32 arithmetic
# 2e-7.
_EXP2 = (1.32646524e-3, 9.67151132e-3, 5.55073396e-2, 2.40222421e-1, 6.93146978e-1, 1.0)

# Added to a small number, it leaves the nearest integer in the low bits of the sum.
_ROUNDING = 1.5 * 2**23


@operation(f32x16, f32x16)
def exp2(builder, x):
    """``2**x`` for x <= 127, 2**-126 for anything smaller than -126."""
    low = _constant(-126.0)
    x = builder.select(builder.fcmp_ordered(">", x, low), x, low)
    shifted = builder.fadd(x, _constant(_ROUNDING))
    f = builder.fsub(x, builder.fsub(shifted, _constant(_ROUNDING)))
    p = _constant(_EXP2[0])
    for c in _EXP2[1:]:
        p = _fma(builder, p, f, _constant(c))
    exponent = builder.shl(builder.bitcast(shifted, INTEGERS), _constant(23))
    return builder.bitcast(builder.add(builder.bitcast(p, INTEGERS), exponent), VECTOR)


_TINY = 0x3F3504F3  # bits of sqrt(1/2)


@operation(f32x16, f32x16)
def log2(builder, x):
    """``log2(x)`` of positive normal numbers, to 1e-7 plus its own rounding; 0 at 1."""
    bits = builder.bitcast(x, INTEGERS)
    exponent = builder.ashr(builder.sub(bits, _constant(_TINY)), _constant(23))
    # in [sqrt(1/2), sqrt(2))
    m = builder.bitcast(builder.sub(bits, builder.shl(exponent, _constant(23))), VECTOR)
    s = builder.fdiv(builder.fsub(m, _constant(1.0)), builder.fadd(m, _constant(1.0)))
    square = builder.fmul(s, s)
    p = _constant(2 / math.log(2) / 9)
    for k in (7, 5, 3, 1):
        p = _fma(builder, p, square, _constant(2 / math.log(2) / k))
    return _fma(builder, p, s, builder.sitofp(exponent, VECTOR))


@operation(types.none, types.CPointer(types.uint64), types.int64, f32x16, f32x16)
def set_spans(builder, words, index, low, high):
    """Sets bits low[r] to high[r] in the r-th of sixteen groups of sixteen bits from
    ``words[index]`` on.

    Both are rounded towards zero; where high < low no bit is set.
    """
    low, high = (builder.fptosi(x, INTEGERS) for x in (low, high))
    bits = builder.sub(builder.shl(_constant(2), high), builder.shl(_constant(1), low))
    bits = builder.select(builder.icmp_signed(">=", high, low), bits, _constant(0))
    narrow = builder.trunc(bits, ir.VectorType(ir.IntType(16), LANES))
    builder.store(
        narrow, builder.bitcast(builder.gep(words, [index]), narrow.type.as_pointer()), align=8
    )


# The mask as the low sixteen bits of a uint64.
bits_of = operation(types.uint64, mask16)(
    lambda builder, mask: builder.zext(builder.bitcast(mask, ir.IntType(LANES)), ir.IntType(64))
)
# The index of the lowest bit that is set in a uint64, if any.
lowest = operation(types.int64, types.uint64)(
    lambda builder, bits: builder.cttz(bits, ir.Constant(ir.IntType(1), 1))
)
