"""Memory in kernels: pointers, stack memory, prefetching, atomics, and rows of a table, one lane
per row.
"""

from itertools import product

import numpy as np
from llvmlite import ir
from numba import float32, types
from numba.core import cgutils
from numba.extending import intrinsic

from clod_adapter._kernels.compiling import inlined
from clod_adapter._kernels.simd import (
    INTEGERS,
    LANES,
    VECTOR,
    call_llvm,
    f32x16,
    mask16,
    operation,
    spread,
)

I32 = ir.IntType(32)
I64 = ir.IntType(64)
NOTHING = ir.VoidType()
FLOATS = types.CPointer(float32)
NUMBERS = types.CPointer(types.int64)
VECTORS = types.CPointer(f32x16)


@intrinsic
def pointer(typingctx, array):
    """The address of a contiguous array; ``p[i]`` is its i-th element in memory order.

    Kernels convert their arguments to pointers first: passing an array counts references
    atomically, and indexing one handles negative indices. Bounds are not checked.
    """

    def codegen(context, builder, signature, args):
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def pointers(typingctx, arguments):
    """A named tuple with ``pointer`` of its arrays, and what else it holds."""
    kinds = [
        types.CPointer(kind.dtype) if isinstance(kind, types.Array) else kind for kind in arguments
    ]
    result = types.BaseTuple.from_types(kinds, arguments.instance_class)

    def codegen(context, builder, signature, args):
        values = cgutils.unpack_tuple(builder, args[0])
        for k, kind in enumerate(arguments):
            if isinstance(kind, types.Array):
                values[k] = context.make_array(kind)(context, builder, values[k]).data
        return context.make_tuple(builder, result, values)

    return result(arguments), codegen


@intrinsic(prefer_literal=True)
def scratch(typingctx, kind, size):
    """A pointer to a constant number of ``kind`` on the stack; LLVM keeps small ones in
    registers.
    """
    element = kind.instance_type

    def codegen(context, builder, signature, args):
        value = context.get_data_type(element)
        room = cgutils.alloca_once(builder, ir.ArrayType(value, size.literal_value))
        return builder.bitcast(room, value.as_pointer())

    return types.CPointer(element)(kind, size), codegen


@operation(types.none, FLOATS, types.int64)
def prefetch(builder, values, index):
    """Prefetches the cache line of ``values[index]``."""
    byte = builder.bitcast(builder.gep(values, [index]), ir.IntType(8).as_pointer())
    call_llvm(
        builder, "llvm.prefetch.p0i8", NOTHING, [byte, *(ir.Constant(I32, v) for v in (0, 3, 1))]
    )


@operation(types.int64, NUMBERS)
def count_up(builder, counter):
    """Atomically adds 1 to ``counter[0]`` and returns its old value."""
    return builder.atomic_rmw("add", counter, ir.Constant(I64, 1), "monotonic")


@inlined
def share(worker, workers, n):
    """The first of n rows that a worker takes, and the first that the next one takes."""
    return n * worker // workers, n * (worker + 1) // workers


def _vector_at(builder, values, *indices):
    """The address of sixteen floats, of which the sum of ``indices`` is the first."""
    for index in indices:
        values = builder.gep(values, [index])
    return builder.bitcast(values, VECTOR.as_pointer())


@operation(f32x16, FLOATS, types.int64)
def load(builder, values, index):
    """``values[index : index + 16]``."""
    return builder.load(_vector_at(builder, values, index), align=4)


@operation(types.none, FLOATS, types.int64, f32x16)
def store(builder, values, index, vector):
    """``values[index : index + 16] = vector``."""
    builder.store(vector, _vector_at(builder, values, index), align=4)


def _masked_load(builder, address, mask):
    arguments = [address, ir.Constant(I32, 4), mask, ir.Constant(VECTOR, [0.0] * LANES)]
    return call_llvm(builder, "llvm.masked.load.v16f32.p0v16f32", VECTOR, arguments)


def _masked_store(builder, address, mask, value):
    arguments = [value, address, ir.Constant(I32, 4), mask]
    call_llvm(builder, "llvm.masked.store.v16f32.p0v16f32", NOTHING, arguments)


@operation(f32x16, mask16, FLOATS, types.int64)
def load_where(builder, mask, values, index):
    """``values[index : index + 16]`` where the mask is set, 0 elsewhere, which is not read."""
    return _masked_load(builder, _vector_at(builder, values, index), mask)


@operation(types.none, mask16, FLOATS, types.int64, f32x16)
def store_where(builder, mask, values, index, vector):
    """``values[index : index + 16] = vector`` where the mask is set."""
    _masked_store(builder, _vector_at(builder, values, index), mask, vector)


def _first(builder, count):
    numbers = ir.Constant(INTEGERS, list(range(LANES)))
    return builder.icmp_signed("<", numbers, spread(builder, builder.trunc(count, I32), INTEGERS))


first_lanes = operation(mask16, types.int64)(_first)  # the first ``count`` of sixteen


@inlined
def load_some(values, index, count):
    """The first ``count`` of ``values[index : index + 16]``, then 0; what is beyond is not read."""
    return load(values, index) if count >= 16 else load_where(first_lanes(count), values, index)


@inlined
def gather(values, rows):
    """``values[rows[lane]]`` in each lane."""
    lanes = scratch(float32, 16)
    for lane in range(16):
        lanes[lane] = values[rows[lane]]
    return load(lanes, 0)


@inlined
def scatter(values, rows, vector):
    """The inverse of ``gather``; of rows that are listed twice the last is stored."""
    values_of_lanes = scratch(float32, 16)
    store(values_of_lanes, 0, vector)
    for lane in range(16):
        values[rows[lane]] = values_of_lanes[lane]


def _transposed(builder, rows):
    """The 16x16 transpose: lane i of vector j is lane j of vector i of ``rows``."""
    half = LANES // 2
    alternating = np.arange(2 * LANES).reshape(2, LANES).T.reshape(2, LANES).tolist()
    low, high = (ir.Constant(INTEGERS, lanes) for lanes in alternating)
    for _ in range(4):
        pairs = zip(rows[:half], rows[half:], strict=True)
        rows = [builder.shuffle_vector(*pair, order) for pair, order in product(pairs, (low, high))]
    return rows


def _addresses(builder, table, rows, width, first):
    """Addresses of the columns of sixteen rows, from ``first`` on."""
    numbers = [builder.load(builder.gep(rows, [ir.Constant(I32, lane)])) for lane in range(LANES)]
    return [_vector_at(builder, table, builder.mul(row, width), first) for row in numbers]


def _lanes(builder, lanes, at):
    """The addresses of sixteen vectors from ``lanes[at]`` on."""
    first = builder.gep(lanes, [at])
    return [builder.gep(first, [ir.Constant(I64, k)]) for k in range(LANES)]


# of a table, the numbers of rows, its width, the first column, their count, lanes, and the first
_of_rows = operation(types.none, FLOATS, NUMBERS, *[types.int64] * 3, VECTORS, types.int64)


@_of_rows
def load_rows(builder, source, rows, width, first, count, lanes, at):
    """``lanes[at + k]`` = column ``first + k`` of sixteen rows of ``source [*, width]``, for
    k < count <= 16.

    ``rows`` are their sixteen numbers. The vectors up to at + 15 are overwritten.
    """
    mask = _first(builder, count)
    addresses = _addresses(builder, source, rows, width, first)
    columns = _transposed(builder, [_masked_load(builder, x, mask) for x in addresses])
    for vector, address in zip(columns, _lanes(builder, lanes, at), strict=True):
        builder.store(vector, address, align=4)


@_of_rows
def store_rows(builder, destination, rows, width, first, count, lanes, at):
    """The inverse of ``load_rows``; of rows that are listed twice the last is stored."""
    mask = _first(builder, count)
    columns = [builder.load(x, align=4) for x in _lanes(builder, lanes, at)]
    addresses = _addresses(builder, destination, rows, width, first)
    for address, row in zip(addresses, _transposed(builder, columns), strict=True):
        _masked_store(builder, address, mask, row)


@inlined
def load_triples(source, row, count, lanes):
    """``lanes[k]`` = column k of ``count`` <= 16 consecutive rows of ``source [*, 3]``; the last
    one repeated.
    """
    columns = scratch(float32, 48)
    for lane in range(16):
        start = 3 * (row + min(lane, count - 1))
        for k in range(3):
            columns[16 * k + lane] = source[start + k]
    for k in range(3):
        lanes[k] = load(columns, 16 * k)


@operation(types.none, FLOATS, types.int64, *[f32x16] * 9)
def store_sums(builder, values, index, *summands):
    """``values[index : index + 9]`` = the sums over the lanes of the nine vectors."""
    nine = _first(builder, ir.Constant(I64, len(summands)))
    even = ir.Constant(INTEGERS, list(range(0, 2 * LANES, 2)))
    odd = ir.Constant(INTEGERS, list(range(1, 2 * LANES, 2)))
    vectors = [*summands, *[summands[-1]] * (LANES - len(summands))]
    while len(vectors) > 1:  # adds neighbouring lanes until one vector holds all the sums, in order
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [
            builder.fadd(builder.shuffle_vector(a, b, even), builder.shuffle_vector(a, b, odd))
            for a, b in pairs
        ]
    _masked_store(builder, _vector_at(builder, values, index), nine, vectors[0])
