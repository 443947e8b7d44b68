"""Sixteen-lane float vectors for Numba, as LLVM vectors.

Numba's loop vectoriser gives up on the splatting loops (aliasing, masks), so the kernels say what
they mean: ``F32x16`` is LLVM's ``<16 x float>`` and ``Mask16`` its ``<16 x i1>``. LLVM lowers them
to one AVX-512, two AVX or four SSE/NEON registers, whichever the processor has.

Vectors are made by ``splat`` and ``load`` and combined by ``+ - *``, ``fma``, ``vmin``, comparisons
``ge``, ``gt``, ``eq``, and ``select``. Loads and stores take a 1-D contiguous
float32 array, or a pointer to one, and the index of the first lane; nothing checks the bounds.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable

from llvmlite import ir
from numba import float32, types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.core.typing.templates import signature as typing_signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
ZERO = float32(0)
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
        return _spread(builder, args[0])

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


def _spread(builder, value):  # type: ignore[no-untyped-def]
    """Sixteen copies of a float; a vector as it is."""
    if value.type == _vector:
        return value
    one = builder.insert_element(ir.Constant(_vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, ir.Constant(_vector, ir.Undefined), ir.Constant(_ivector, [0] * LANES))


def _operators(name: str, *operators: Callable[..., object]) -> None:
    """Defines operators of two vectors, or of a vector and a float32."""
    pairs = (f32x16, f32x16), (f32x16, types.float32), (types.float32, f32x16)

    class Typing(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args, kws):  # type: ignore[no-untyped-def]
            return typing_signature(f32x16, *args) if tuple(args) in pairs else None

    def lower(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return getattr(builder, name)(*(_spread(builder, arg) for arg in args), flags=("nsz", "contract"))

    for each in operators:
        infer_global(each)(Typing)
        for pair in pairs:
            lower_builtin(each, *pair)(lower)


# Not ``overload``: inlining hundreds of operators takes numba minutes.
_operators("fadd", operator.add, operator.iadd)
_operators("fsub", operator.sub, operator.isub)
_operators("fmul", operator.mul, operator.imul)
_operators("fdiv", operator.truediv, operator.itruediv)


@infer_global(operator.neg)
class _Negative(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args, kws):  # type: ignore[no-untyped-def]
        return typing_signature(f32x16, f32x16) if tuple(args) == (f32x16,) else None


@lower_builtin(operator.neg, f32x16)
def _negative(context, builder, signature, args):  # type: ignore[no-untyped-def]
    return builder.fneg(args[0])


def _compare(predicate: str):  # type: ignore[no-untyped-def]
    @intrinsic
    def operation(typingctx, a, b):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return builder.fcmp_ordered(predicate, *args)

        return mask16(f32x16, f32x16), codegen

    return operation


ge, gt, eq = _compare(">="), _compare(">"), _compare("==")


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


# Where one is NaN, the second is the result.
vmin, vmax = _extremum("<"), _extremum(">")


def _unary(intrinsic_name: str):  # type: ignore[no-untyped-def]
    @intrinsic
    def operation(typingctx, a):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return _call(builder, intrinsic_name, _vector, args)

        return f32x16(f32x16), codegen

    return operation


vsqrt, vfloor, vceil, vabs = (_unary(f"llvm.{name}.v16f32") for name in ("sqrt", "floor", "ceil", "fabs"))


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


_TINY = 0x3F3504F3  # bits of sqrt(1/2)


@intrinsic
def log2(typingctx, x):  # type: ignore[no-untyped-def]
    """``log2(x)`` of positive normal numbers, to 1e-7 beside its own rounding; 0 at 1."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        def whole(value):  # type: ignore[no-untyped-def]
            return ir.Constant(_ivector, [value] * LANES)

        bits = builder.bitcast(args[0], _ivector)
        exponent = builder.ashr(builder.sub(bits, whole(_TINY)), whole(23))
        m = builder.bitcast(builder.sub(bits, builder.shl(exponent, whole(23))), _vector)  # in [sqrt(1/2), sqrt(2))
        s = builder.fdiv(builder.fsub(m, _constant(1.0)), builder.fadd(m, _constant(1.0)))
        square, p = builder.fmul(s, s), _constant(2 / math.log(2) / 9)
        for k in (7, 5, 3, 1):
            p = _call(builder, "llvm.fmuladd.v16f32", _vector, [p, square, _constant(2 / math.log(2) / k)])
        return _call(builder, "llvm.fmuladd.v16f32", _vector, [p, s, builder.sitofp(exponent, _vector)])

    return f32x16(f32x16), codegen


def _transposed(builder, rows):  # type: ignore[no-untyped-def]
    """Sixteen vectors whose i-th lane of the j-th is the j-th lane of the i-th given."""
    half = LANES // 2
    low = ir.Constant(_ivector, [lane for k in range(half) for lane in (k, LANES + k)])
    high = ir.Constant(_ivector, [lane for k in range(half, LANES) for lane in (k, LANES + k)])
    for _ in range(4):
        pairs = [(rows[i], rows[i + half]) for i in range(half)]
        rows = [builder.shuffle_vector(*pair, order) for pair in pairs for order in (low, high)]
    return rows


def _row_access(builder, source, rows, width, first, count):  # type: ignore[no-untyped-def]
    """Addresses of sixteen rows' ``[first : first + count]`` and the mask of so many lanes."""
    i64, i32 = ir.IntType(64), ir.IntType(32)
    addresses = []
    for lane in range(LANES):
        row = builder.load(builder.gep(rows, [ir.Constant(i32, lane)]))
        index = builder.add(builder.mul(row, width), first)
        addresses.append(builder.bitcast(builder.gep(source, [index]), _vector.as_pointer()))
    numbers = ir.Constant(ir.VectorType(i64, LANES), list(range(LANES)))
    one = builder.insert_element(ir.Constant(numbers.type, ir.Undefined), count, ir.Constant(i32, 0))
    many = builder.shuffle_vector(one, one, ir.Constant(_ivector, [0] * LANES))
    return addresses, builder.icmp_signed("<", numbers, many)


@intrinsic
def load_rows(typingctx, source, rows, width, first, count, lanes, at):  # type: ignore[no-untyped-def]
    """``lanes[at + k]`` = column ``first + k`` of sixteen rows of ``source [*, width]``, for k < count <= 16.

    ``rows`` points to their sixteen numbers (int64), ``lanes`` to vectors; those up to at + 15 are overwritten.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        source, rows, width, first, count, lanes, at = args
        addresses, mask = _row_access(builder, source, rows, width, first, count)
        empty = ir.Constant(_vector, [0.0] * LANES)
        arguments = [ir.Constant(ir.IntType(32), 4), mask, empty]
        found = [_call(builder, "llvm.masked.load.v16f32.p0v16f32", _vector, [a, *arguments]) for a in addresses]
        for k, vector in enumerate(_transposed(builder, found)):
            builder.store(vector, builder.gep(lanes, [builder.add(at, ir.Constant(ir.IntType(64), k))]), align=4)
        return context.get_dummy_value()

    i64 = types.int64
    return types.none(source, types.CPointer(i64), i64, i64, i64, types.CPointer(f32x16), i64), codegen


@intrinsic
def store_rows(typingctx, destination, rows, width, first, count, lanes, at):  # type: ignore[no-untyped-def]
    """The reverse of ``load_rows``; of rows that are named twice the last counts."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        destination, rows, width, first, count, lanes, at = args
        addresses, mask = _row_access(builder, destination, rows, width, first, count)
        found = [
            builder.load(builder.gep(lanes, [builder.add(at, ir.Constant(ir.IntType(64), k))]), align=4)
            for k in range(LANES)
        ]
        for address, row in zip(addresses, _transposed(builder, found), strict=True):
            arguments = [row, address, ir.Constant(ir.IntType(32), 4), mask]
            _call(builder, "llvm.masked.store.v16f32.p0v16f32", ir.VoidType(), arguments)
        return context.get_dummy_value()

    i64 = types.int64
    return types.none(destination, types.CPointer(i64), i64, i64, i64, types.CPointer(f32x16), i64), codegen


@intrinsic
def bits_of(typingctx, mask):  # type: ignore[no-untyped-def]
    """The mask as the low sixteen bits of a uint64."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))

    return types.uint64(mask16), codegen


@intrinsic(prefer_literal=True)
def set_spans(typingctx, words, index, low, high, quarter):  # type: ignore[no-untyped-def]
    """In the r-th of ``quarter`` groups of ``quarter`` bits from ``words[index]`` on, sets bits low[r] to high[r].

    Both are rounded towards zero; where high < low no bit is set. ``quarter`` is 8 or 16, words are uint64.
    """
    rows = quarter.literal_value

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        low, high = (builder.fptosi(x, _ivector) for x in args[2:4])
        ones = ir.Constant(_ivector, [1] * LANES)
        bits = builder.sub(builder.shl(ir.Constant(_ivector, [2] * LANES), high), builder.shl(ones, low))
        bits = builder.select(builder.icmp_signed(">=", high, low), bits, ir.Constant(_ivector, [0] * LANES))
        narrow = builder.trunc(bits, ir.VectorType(ir.IntType(rows), LANES))
        first = ir.Constant(ir.VectorType(ir.IntType(32), rows), list(range(rows)))
        narrow = builder.shuffle_vector(narrow, narrow, first)
        data = builder.gep(args[0], [args[1]])
        builder.store(narrow, builder.bitcast(data, narrow.type.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.none(words, types.intp, f32x16, f32x16, quarter), codegen


@intrinsic
def lowest(typingctx, bits):  # type: ignore[no-untyped-def]
    """Index of the lowest bit that is set in a uint64 other than 0."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        i64 = ir.IntType(64)
        kind = ir.FunctionType(i64, [i64, ir.IntType(1)])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.cttz.i64")
        return builder.call(function, [args[0], ir.Constant(ir.IntType(1), 1)])

    return types.int64(types.uint64), codegen


@intrinsic
def prefetch(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Asks for the cache line of ``array[index]``, which will be read soon."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = builder.gep(_data(context, builder, signature.args[0], args[0]), [args[1]])
        byte, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(function, [builder.bitcast(data, byte), *(ir.Constant(i32, v) for v in (0, 3, 1))])
        return context.get_dummy_value()

    return types.none(array, types.intp), codegen


@intrinsic
def fetch_add(typingctx, array, amount):  # type: ignore[no-untyped-def]
    """Atomically adds to ``array[0]`` (int64) and returns what it was."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = _data(context, builder, signature.args[0], args[0])
        return builder.atomic_rmw("add", data, args[1], "monotonic")

    return types.int64(array, types.int64), codegen
