"""Sixteen-lane float vectors for Numba, as LLVM vectors.

Numba's loop vectoriser does not vectorise the splatting loops (aliasing, masks), so the kernels use explicit vectors:
``F32x16`` is LLVM's ``<16 x float>`` and ``Mask16`` its ``<16 x i1>``. LLVM lowers them to one AVX-512, two AVX or four
SSE/NEON registers, whichever the processor has.

Vectors are made by ``splat`` and ``load`` and combined by ``+ - *``, ``fma``, ``vmin``, comparisons
``ge``, ``gt``, ``eq``, and ``select``. Loads and stores take a 1-D contiguous
float32 array, or a pointer to one, and the index of the first lane; bounds are not checked.
"""

from __future__ import annotations

import operator
from collections.abc import Callable

from llvmlite import ir
from numba import float32, types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.core.typing.templates import signature as typing_signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from clod_adapter._kernels.pointers import data_of

LANES = 16
ZERO = float32(0)
VECTOR = ir.VectorType(ir.FloatType(), LANES)
INTEGERS = ir.VectorType(ir.IntType(32), LANES)
_mask = ir.VectorType(ir.IntType(1), LANES)


def _vector_type(name: str, llvm: ir.Type) -> types.Type:
    """A type of values that LLVM keeps in registers."""
    kind = type(name, (types.Type,), {})

    def of_type(self, dmm, fe_type):  # type: ignore[no-untyped-def]
        models.PrimitiveModel.__init__(self, dmm, fe_type, llvm)

    register_model(kind)(type(f"{name}Model", (models.PrimitiveModel,), {"__init__": of_type}))
    return kind(name=name)


f32x16, mask16 = _vector_type("F32x16", VECTOR), _vector_type("Mask16", _mask)


def call_llvm(builder, name, result, arguments):  # type: ignore[no-untyped-def]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(result, [a.type for a in arguments]), name
    )
    return builder.call(function, arguments)


def _pointer(context, builder, kind, value, index):  # type: ignore[no-untyped-def]
    return builder.bitcast(builder.gep(data_of(context, builder, kind, value), [index]), VECTOR.as_pointer())


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
    if value.type == VECTOR:
        return value
    one = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, ir.Constant(VECTOR, ir.Undefined), ir.Constant(INTEGERS, [0] * LANES))


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


def operation(result, *kinds):  # type: ignore[no-untyped-def]
    """Makes a function of a builder and one to three LLVM values an intrinsic from ``kinds`` to ``result``."""

    def intrinsic_of(build):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return build(builder, *args)

        typed = result(*kinds), codegen
        takes = (lambda ctx, a: typed), (lambda ctx, a, b: typed), (lambda ctx, a, b, c: typed)
        return intrinsic(takes[len(kinds) - 1])

    return intrinsic_of


def llvm_function(name, count):  # type: ignore[no-untyped-def]
    """LLVM's intrinsic ``name`` of ``count`` vectors."""
    return operation(f32x16, *[f32x16] * count)(
        lambda builder, *args: call_llvm(builder, f"llvm.{name}.v16f32", VECTOR, args)
    )


# Sixteen copies of a float32.
splat = operation(f32x16, types.float32)(_spread)
# fmuladd fuses where the processor can and is two operations where it cannot.
fma = llvm_function("fmuladd", 3)

_pair = f32x16, f32x16
_compare, _extremum = operation(mask16, *_pair), operation(f32x16, *_pair)
ge = _compare(lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
gt = _compare(lambda builder, a, b: builder.fcmp_ordered(">", a, b))
eq = _compare(lambda builder, a, b: builder.fcmp_ordered("==", a, b))
# If one is NaN, the result is the second.
vmin = _extremum(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
vmax = _extremum(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))


@operation(mask16, mask16, mask16)
def both(builder, a, b):  # type: ignore[no-untyped-def]
    """Lanes set in a and in b."""
    return builder.and_(a, b)


@operation(mask16, mask16, mask16)
def but_not(builder, a, b):  # type: ignore[no-untyped-def]
    """Lanes set in a and not in b."""
    return builder.and_(a, builder.xor(b, ir.Constant(_mask, [1] * LANES)))


@operation(types.boolean, mask16)
def anywhere(builder, mask):  # type: ignore[no-untyped-def]
    """Whether any lane is set."""
    bits = builder.bitcast(mask, ir.IntType(LANES))
    return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))


@operation(f32x16, mask16, f32x16, f32x16)
def select(builder, mask, a, b):  # type: ignore[no-untyped-def]
    """a where the mask is set, b elsewhere."""
    return builder.select(mask, a, b)
