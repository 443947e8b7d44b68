"""Blocks of 4x4 pixels of an image as vectors, a lane per pixel: loaded, and stored."""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from clod_adapter._kernels.simd import INTEGERS, LANES, VECTOR, f32x16

SIDE = 4
_FOUR, _TWELVE = (ir.VectorType(ir.FloatType(), count) for count in (SIDE, 3 * SIDE))


def _indices(values):  # type: ignore[no-untyped-def]
    return ir.Constant(ir.VectorType(ir.IntType(32), len(values)), values)


def _rows(builder, image, index, step, kind):  # type: ignore[no-untyped-def]
    """Addresses of the block's four rows, the first at ``index``, ``step`` elements apart."""
    for row in range(SIDE):
        at = builder.add(index, builder.mul(step, ir.Constant(ir.IntType(64), row)))
        yield row, builder.bitcast(builder.gep(image, [at]), kind.as_pointer())


def _joined(builder, rows):  # type: ignore[no-untyped-def]
    """One vector of four rows of four."""
    halves = [builder.shuffle_vector(*rows[k : k + 2], _indices(list(range(8)))) for k in (0, 2)]
    return builder.shuffle_vector(*halves, ir.Constant(INTEGERS, list(range(LANES))))


@intrinsic
def store_plane(typingctx, plane, index, step, value):  # type: ignore[no-untyped-def]
    """Stores a block of one channel, its first pixel at ``plane[index]``, rows ``step`` elements apart."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        for row, address in _rows(builder, *args[:3], _FOUR):
            lanes = _indices([SIDE * row + k for k in range(SIDE)])
            builder.store(builder.shuffle_vector(args[3], args[3], lanes), address, align=4)
        return context.get_dummy_value()

    return types.none(plane, types.int64, types.int64, f32x16), codegen


@intrinsic
def store_colors(typingctx, image, index, step, red, green, blue):  # type: ignore[no-untyped-def]
    """Stores a block of three interleaved channels, as ``store_plane``."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        red, green, blue = args[3:]
        for row, address in _rows(builder, *args[:3], _TWELVE):
            first = [lane for k in range(SIDE) for lane in (SIDE * row + k, LANES + SIDE * row + k, 0)]
            pairs = builder.shuffle_vector(red, green, _indices([*first, 0, 0, 0, 0]))
            own = [LANES + SIDE * row + k // 3 if k % 3 == 2 else k for k in range(3 * SIDE)]
            builder.store(builder.shuffle_vector(pairs, blue, _indices(own)), address, align=4)
        return context.get_dummy_value()

    return types.none(image, types.int64, types.int64, f32x16, f32x16, f32x16), codegen


@intrinsic
def load_plane(typingctx, plane, index, step):  # type: ignore[no-untyped-def]
    """The inverse of ``store_plane``."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return _joined(builder, [builder.load(address, align=4) for _, address in _rows(builder, *args, _FOUR)])

    return f32x16(plane, types.int64, types.int64), codegen


@intrinsic
def load_colors(typingctx, image, index, step, lanes):  # type: ignore[no-untyped-def]
    """The inverse of ``store_colors``, into ``lanes[:3]``."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        rows = [builder.load(address, align=4) for _, address in _rows(builder, *args[:3], _TWELVE)]
        for channel in range(3):
            order = _indices([channel + 3 * k for k in range(SIDE)])
            vector = _joined(builder, [builder.shuffle_vector(row, row, order) for row in rows])
            assert vector.type == VECTOR
            builder.store(vector, builder.gep(args[3], [ir.Constant(ir.IntType(64), channel)]), align=4)
        return context.get_dummy_value()

    return types.none(image, types.int64, types.int64, types.CPointer(f32x16)), codegen
