"""Elementary functions of sixteen-lane vectors: square root, rounding, absolute value, exp2 and log2."""

from __future__ import annotations

import math

from llvmlite import ir

from clod_adapter._kernels.simd import INTEGERS, LANES, VECTOR, call_llvm, f32x16, llvm_function, operation


def _constant(value: float) -> ir.Constant:
    return ir.Constant(VECTOR, [value] * LANES)


def _whole(value: int) -> ir.Constant:
    return ir.Constant(INTEGERS, [value] * LANES)


vsqrt, vfloor, vceil, vabs = (llvm_function(name, 1) for name in ("sqrt", "floor", "ceil", "fabs"))


# Minimax polynomial of 2^f on [-0.5, 0.5] with p(0) = 1: relative error 9e-8, in float32 arithmetic 2e-7.
_EXP2 = (1.32646524e-3, 9.67151132e-3, 5.55073396e-2, 2.40222421e-1, 6.93146978e-1, 1.0)

# Added to a small number, it leaves the nearest integer in the low bits of the sum.
_ROUNDING = 1.5 * 2**23


@operation(f32x16, f32x16)
def exp2(builder, x):  # type: ignore[no-untyped-def]
    """``2**x`` for x <= 127, 2**-126 for anything smaller than -126."""
    low = _constant(-126.0)
    x = builder.select(builder.fcmp_ordered(">", x, low), x, low)
    shifted = builder.fadd(x, _constant(_ROUNDING))
    f = builder.fsub(x, builder.fsub(shifted, _constant(_ROUNDING)))
    p = _constant(_EXP2[0])
    for c in _EXP2[1:]:
        p = call_llvm(builder, "llvm.fmuladd.v16f32", VECTOR, [p, f, _constant(c)])
    exponent = builder.shl(builder.bitcast(shifted, INTEGERS), _whole(23))
    return builder.bitcast(builder.add(builder.bitcast(p, INTEGERS), exponent), VECTOR)


_TINY = 0x3F3504F3  # bits of sqrt(1/2)


@operation(f32x16, f32x16)
def log2(builder, x):  # type: ignore[no-untyped-def]
    """``log2(x)`` of positive normal numbers, to 1e-7 plus its own rounding; 0 at 1."""
    bits = builder.bitcast(x, INTEGERS)
    exponent = builder.ashr(builder.sub(bits, _whole(_TINY)), _whole(23))
    m = builder.bitcast(builder.sub(bits, builder.shl(exponent, _whole(23))), VECTOR)  # in [sqrt(1/2), sqrt(2))
    s = builder.fdiv(builder.fsub(m, _constant(1.0)), builder.fadd(m, _constant(1.0)))
    square, p = builder.fmul(s, s), _constant(2 / math.log(2) / 9)
    for k in (7, 5, 3, 1):
        p = call_llvm(builder, "llvm.fmuladd.v16f32", VECTOR, [p, square, _constant(2 / math.log(2) / k)])
    return call_llvm(builder, "llvm.fmuladd.v16f32", VECTOR, [p, s, builder.sitofp(exponent, VECTOR)])
