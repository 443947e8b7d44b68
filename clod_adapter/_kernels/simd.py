"""Sixteen-lane float vectors for Numba, as LLVM vectors.

LLVM lowers ``<16 x float>`` to one AVX-512, two AVX or four SSE/NEON registers.
"""

import operator
from inspect import Parameter, Signature

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.core.typing.templates import signature as typing_signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
VECTOR = ir.VectorType(ir.FloatType(), LANES)
INTEGERS = ir.VectorType(ir.IntType(32), LANES)
MASK = ir.VectorType(ir.IntType(1), LANES)


def _vector_type(name: str, llvm: ir.Type) -> types.Type:
    """A type of values that LLVM keeps in registers."""
    kind = type(name, (types.Type,), {})

    def of_type(self, dmm, fe_type):
        models.PrimitiveModel.__init__(self, dmm, fe_type, llvm)

    register_model(kind)(type(f"{name}Model", (models.PrimitiveModel,), {"__init__": of_type}))
    return kind(name=name)


f32x16 = _vector_type("F32x16", VECTOR)
mask16 = _vector_type("Mask16", MASK)


def call_llvm(builder, name, result, arguments):
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


def spread(builder, value, kind=VECTOR):
    """Sixteen copies of a number, rounded to float32 for floats; a vector as it is."""
    if value.type == kind:
        return value
    if kind == VECTOR and isinstance(value.type, ir.IntType):
        value = builder.sitofp(value, kind.element)
    elif value.type == ir.DoubleType():
        value = builder.fptrunc(value, kind.element)
    single = builder.insert_element(
        ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0)
    )
    return builder.shuffle_vector(
        single, ir.Constant(kind, ir.Undefined), ir.Constant(INTEGERS, [0] * LANES)
    )


def _operators(name, kinds, flags, *operators):
    """Defines operators of vectors: ``kinds`` are the arguments' types."""

    class Typing(AbstractTemplate):  # type: ignore[misc]
        # tried before the generic ones, of which each takes time to fail
        metadata = {"target": "cpu"}

        def generic(self, args, kws):
            return typing_signature(f32x16, *args) if tuple(args) in kinds else None

    def lower(context, builder, signature, args):
        return getattr(builder, name)(*(spread(builder, arg) for arg in args), flags=flags)

    for function in operators:
        infer_global(function)(Typing)
        for kind in kinds:
            lower_builtin(function, *kind)(lower)


# Not ``overload``: inlining hundreds of operators takes numba minutes.
_numbers = types.float32, types.float64, types.int64
_pairs = [(f32x16, f32x16)]
for _number in _numbers:
    _pairs += [(f32x16, _number), (_number, f32x16)]
_loose = "nsz", "contract"
_operators("fadd", _pairs, _loose, operator.add, operator.iadd)
_operators("fsub", _pairs, _loose, operator.sub, operator.isub)
_operators("fmul", _pairs, _loose, operator.mul, operator.imul)
_operators("fdiv", _pairs, _loose, operator.truediv, operator.itruediv)
_operators("fneg", ((f32x16,),), (), operator.neg)


def operation(result, *kinds):
    """Makes a function of a builder and LLVM values an intrinsic from ``kinds`` to ``result``.

    Where it takes a vector, it takes a number for sixteen copies of it.
    """

    def intrinsic_of(build):
        def codegen(context, builder, signature, args):
            values = [
                spread(builder, arg) if kind == f32x16 else arg
                for arg, kind in zip(args, kinds, strict=True)
            ]
            value = build(builder, *values)
            return context.get_dummy_value() if value is None else value

        def typed(typingctx, *args):
            argument_types = [
                arg if kind == f32x16 and arg in _numbers else kind
                for arg, kind in zip(args, kinds, strict=True)
            ]
            return result(*argument_types), codegen

        names = [f"given_{k}" for k in range(1 + len(kinds))]
        parameters = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in names]
        typed.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        return intrinsic(typed)

    return intrinsic_of


def llvm_function(name, count):
    """LLVM's intrinsic ``name`` of ``count`` vectors."""
    return operation(f32x16, *[f32x16] * count)(
        lambda builder, *args: call_llvm(builder, f"llvm.{name}.v16f32", VECTOR, args)
    )


def lanes(values):
    """A function that returns the vector of sixteen numbers."""
    return operation(f32x16)(lambda builder: ir.Constant(VECTOR, list(map(float, values))))


# Sixteen copies of a number.
splat = operation(f32x16, f32x16)(lambda builder, vector: vector)
# fmuladd fuses where the processor can and is two operations where it cannot.
fma = llvm_function("fmuladd", 3)

_pair = f32x16, f32x16
_compare = operation(mask16, *_pair)
_extremum = operation(f32x16, *_pair)
ge = _compare(lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
gt = _compare(lambda builder, a, b: builder.fcmp_ordered(">", a, b))
eq = _compare(lambda builder, a, b: builder.fcmp_ordered("==", a, b))
# If one is NaN, the result is the second.
vmin = _extremum(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
vmax = _extremum(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))

_logic = operation(mask16, mask16, mask16)
both = _logic(lambda builder, a, b: builder.and_(a, b))
# a where the mask is set, b elsewhere.
select = operation(f32x16, mask16, *_pair)(lambda builder, mask, a, b: builder.select(mask, a, b))
