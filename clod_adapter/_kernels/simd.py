"""Sixteen-lane float vectors for Numba, as LLVM vectors.

Numba's loop vectoriser gives up on the splatting loops (aliasing, masks), so the kernels say what
they mean: ``F32x16`` is LLVM's ``<16 x float>`` and ``Mask16`` its ``<16 x i1>``. LLVM lowers them
to one AVX-512, two AVX or four SSE/NEON registers, whichever the processor has.

Vectors are made by ``splat`` and ``load`` and combined by ``+ - *``, ``fma``, ``vmin``, comparisons
``ge``, ``gt``, and ``select``. Loads and stores take a 1-D contiguous
float32 array, or a pointer to one, and the index of the first lane; nothing checks the bounds.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

LANES = 16
_vector = ir.VectorType(ir.FloatType(), LANES)
_ivector = ir.VectorType(ir.IntType(32), LANES)
_mask = ir.VectorType(ir.IntType(1), LANES)


class _F32x16(types.Type):
    def __init__(self) -> None:
        super().__init__(name="F32x16")


class _Mask16(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Mask16")


f32x16 = _F32x16()
mask16 = _Mask16()


@register_model(_F32x16)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):  # type: ignore[no-untyped-def]
        super().__init__(dmm, fe_type, _vector)


@register_model(_Mask16)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):  # type: ignore[no-untyped-def]
        super().__init__(dmm, fe_type, _mask)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_vector, [value] * LANES)


def _call(builder, name, result, arguments):  # type: ignore[no-untyped-def]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(result, [a.type for a in arguments]), name
    )
    return builder.call(function, arguments)


def _data(context, builder, kind, value):  # type: ignore[no-untyped-def]
    """The address of an array's elements, or the pointer that was given."""
    return value if isinstance(kind, types.CPointer) else context.make_array(kind)(context, builder, value).data


def _pointer(context, builder, kind, value, index):  # type: ignore[no-untyped-def]
    return builder.bitcast(builder.gep(_data(context, builder, kind, value), [index]), _vector.as_pointer())


@intrinsic
def splat(typingctx, value):  # type: ignore[no-untyped-def]
    """Sixteen copies of a float32."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        one = builder.insert_element(ir.Constant(_vector, ir.Undefined), args[0], ir.Constant(ir.IntType(32), 0))
        zeros = ir.Constant(_ivector, [0] * LANES)
        return builder.shuffle_vector(one, ir.Constant(_vector, ir.Undefined), zeros)

    return f32x16(types.float32), codegen


@intrinsic
def load(typingctx, array, index):  # type: ignore[no-untyped-def]
    """``array[index : index + 16]``."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.load(_pointer(context, builder, signature.args[0], args[0], args[1]), align=4)

    return f32x16(array, types.intp), codegen


@intrinsic
def store(typingctx, array, index, value):  # type: ignore[no-untyped-def]
    """``array[index : index + 16] = value``."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = _pointer(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], pointer, align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, f32x16), codegen


def _binary(name: str):  # type: ignore[no-untyped-def]
    @intrinsic
    def operation(typingctx, a, b):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return getattr(builder, name)(*args, flags=("nsz", "contract"))

        return f32x16(f32x16, f32x16), codegen

    return operation


_add, _sub, _mul = _binary("fadd"), _binary("fsub"), _binary("fmul")


@overload(operator.add, inline="always")
def _overload_add(a, b):  # type: ignore[no-untyped-def]
    if a is f32x16 and b is f32x16:
        return lambda a, b: _add(a, b)
    return None


@overload(operator.sub, inline="always")
def _overload_sub(a, b):  # type: ignore[no-untyped-def]
    if a is f32x16 and b is f32x16:
        return lambda a, b: _sub(a, b)
    return None


@overload(operator.mul, inline="always")
def _overload_mul(a, b):  # type: ignore[no-untyped-def]
    if a is f32x16 and b is f32x16:
        return lambda a, b: _mul(a, b)
    return None


def _compare(predicate: str):  # type: ignore[no-untyped-def]
    @intrinsic
    def operation(typingctx, a, b):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return builder.fcmp_ordered(predicate, *args)

        return mask16(f32x16, f32x16), codegen

    return operation


ge, gt = _compare(">="), _compare(">")


def _ternary(intrinsic_name: str):  # type: ignore[no-untyped-def]
    @intrinsic
    def operation(typingctx, a, b, c):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return _call(builder, intrinsic_name, _vector, args)

        return f32x16(f32x16, f32x16, f32x16), codegen

    return operation


# fmuladd fuses where the processor can and is two operations where it cannot.
fma = _ternary("llvm.fmuladd.v16f32")


def _extremum(predicate: str):  # type: ignore[no-untyped-def]
    @intrinsic
    def operation(typingctx, a, b):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return builder.select(builder.fcmp_ordered(predicate, *args), *args)

        return f32x16(f32x16, f32x16), codegen

    return operation


vmin = _extremum("<")


@intrinsic
def both(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Lanes set in a and in b."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.and_(*args)

    return mask16(mask16, mask16), codegen


@intrinsic
def but_not(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Lanes set in a and not in b."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.and_(args[0], builder.xor(args[1], ir.Constant(_mask, [1] * LANES)))

    return mask16(mask16, mask16), codegen


@intrinsic
def anywhere(typingctx, mask):  # type: ignore[no-untyped-def]
    """Whether any lane is set."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask16), codegen


@intrinsic
def select(typingctx, mask, a, b):  # type: ignore[no-untyped-def]
    """a where the mask is set, b elsewhere."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.select(*args)

    return f32x16(mask16, f32x16, f32x16), codegen


def _pairwise(builder, vectors):  # type: ignore[no-untyped-def]
    """Adds neighbouring lanes of up to 16 vectors until one vector holds all their sums, in order."""
    even, odd = range(0, 2 * LANES, 2), range(1, 2 * LANES, 2)
    while len(vectors) > 1:
        vectors = [*vectors, vectors[-1]] if len(vectors) % 2 else vectors
        vectors = [
            builder.fadd(*(builder.shuffle_vector(a, b, ir.Constant(_ivector, list(half))) for half in (even, odd)))
            for a, b in zip(vectors[::2], vectors[1::2], strict=True)
        ]
    return vectors[0]


@intrinsic
def store_sums(typingctx, array, index, a, b, c, d, e, f, g, h, i):  # type: ignore[no-untyped-def]
    """``array[index : index + 9]`` = the sums over the lanes of the nine vectors."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        sums = _pairwise(builder, list(args[2:]))
        data = _data(context, builder, signature.args[0], args[0])
        pointer = builder.gep(data, [args[1]])
        eight = builder.shuffle_vector(sums, sums, ir.Constant(ir.VectorType(ir.IntType(32), 8), list(range(8))))
        builder.store(eight, builder.bitcast(pointer, eight.type.as_pointer()), align=4)
        ninth = builder.extract_element(sums, ir.Constant(ir.IntType(32), 8))
        builder.store(ninth, builder.gep(pointer, [ir.Constant(ir.IntType(64), 8)]))
        return context.get_dummy_value()

    return types.none(array, types.intp, *([f32x16] * 9)), codegen


# Minimax polynomial of 2^f on [-0.5, 0.5] with p(0) = 1: relative error 9e-8, in float32 arithmetic 2e-7.
_EXP2 = (1.32646524e-3, 9.67151132e-3, 5.55073396e-2, 2.40222421e-1, 6.93146978e-1, 1.0)


@intrinsic
def exp2(typingctx, x):  # type: ignore[no-untyped-def]
    """``2**x`` for x <= 127, 2**-126 for anything smaller than -126."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        low = _constant(-126.0)
        x = builder.select(builder.fcmp_ordered(">", args[0], low), args[0], low)
        whole = _call(builder, "llvm.rint.v16f32", _vector, [x])
        f = builder.fsub(x, whole)
        p = _constant(_EXP2[0])
        for c in _EXP2[1:]:
            p = _call(builder, "llvm.fmuladd.v16f32", _vector, [p, f, _constant(c)])
        exponent = builder.shl(builder.fptosi(whole, _ivector), ir.Constant(_ivector, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(p, _ivector), exponent), _vector)

    return f32x16(f32x16), codegen


@intrinsic
def quotient(typingctx, a, b):  # type: ignore[no-untyped-def]
    """``a / b``."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.fdiv(*args)

    return f32x16(f32x16, f32x16), codegen


@intrinsic
def fetch_add(typingctx, array, amount):  # type: ignore[no-untyped-def]
    """Atomically adds to ``array[0]`` (int64) and returns what it was."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = _data(context, builder, signature.args[0], args[0])
        return builder.atomic_rmw("add", data, args[1], "monotonic")

    return types.int64(array, types.int64), codegen
