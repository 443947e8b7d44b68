"""Memory in kernels: pointers, stack memory, prefetching, atomics, and rows of a table, one lane per row."""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from clod_adapter._kernels.simd import INTEGERS, LANES, VECTOR, call_llvm, data_of, f32x16


@intrinsic
def pointer(typingctx, array):
    """The address of a contiguous array; ``p[i]`` is its i-th element in memory order.

    Kernels convert their arguments to pointers first: passing an array counts references atomically, and indexing one
    handles negative indices. Bounds are not checked.
    """

    def codegen(context, builder, signature, args):
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic(prefer_literal=True)
def scratch(typingctx, kind, size):
    """A pointer to a constant number of ``kind`` on the stack; LLVM keeps small ones in registers."""
    element = kind.instance_type

    def codegen(context, builder, signature, args):
        value = context.get_data_type(element)
        room = cgutils.alloca_once(builder, ir.ArrayType(value, size.literal_value))
        return builder.bitcast(room, value.as_pointer())

    return types.CPointer(element)(kind, size), codegen


@intrinsic
def prefetch(typingctx, array, index):
    """Prefetches the cache line of ``array[index]``."""

    def codegen(context, builder, signature, args):
        data = builder.gep(data_of(context, builder, signature.args[0], args[0]), [args[1]])
        byte, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
        arguments = [builder.bitcast(data, byte), *(ir.Constant(i32, v) for v in (0, 3, 1))]
        call_llvm(builder, "llvm.prefetch.p0i8", ir.VoidType(), arguments)
        return context.get_dummy_value()

    return types.none(array, types.intp), codegen


@intrinsic
def fetch_add(typingctx, array, amount):
    """Atomically adds to ``array[0]`` (int64) and returns its old value."""

    def codegen(context, builder, signature, args):
        data = data_of(context, builder, signature.args[0], args[0])
        return builder.atomic_rmw("add", data, args[1], "monotonic")

    return types.int64(array, types.int64), codegen


def _masked(builder, kind, address, mask, *values):
    """LLVM's masked ``load`` or ``store`` of a vector."""
    address, align = builder.bitcast(address, VECTOR.as_pointer()), ir.Constant(ir.IntType(32), 4)
    if kind == "load":
        empty = ir.Constant(VECTOR, [0.0] * LANES)
        return call_llvm(builder, "llvm.masked.load.v16f32.p0v16f32", VECTOR, [address, align, mask, empty])
    return call_llvm(builder, "llvm.masked.store.v16f32.p0v16f32", ir.VoidType(), [*values, address, align, mask])


@intrinsic
def load_where(typingctx, mask, array, index):
    """``array[index : index + 16]`` where the mask is set, 0 elsewhere, which is not read."""

    def codegen(context, builder, signature, args):
        return _masked(builder, "load", builder.gep(args[1], [args[2]]), args[0])

    return f32x16(mask, array, types.intp), codegen


@intrinsic
def store_where(typingctx, mask, array, index, value):
    """``array[index : index + 16] = value`` where the mask is set."""

    def codegen(context, builder, signature, args):
        _masked(builder, "store", builder.gep(args[1], [args[2]]), args[0], args[3])
        return context.get_dummy_value()

    return types.none(mask, array, types.intp, f32x16), codegen


def _transposed(builder, rows):
    """The 16x16 transpose: lane i of vector j is lane j of vector i of ``rows``."""
    half = LANES // 2
    low = ir.Constant(INTEGERS, [lane for k in range(half) for lane in (k, LANES + k)])
    high = ir.Constant(INTEGERS, [lane for k in range(half, LANES) for lane in (k, LANES + k)])
    for _ in range(4):
        pairs = [(rows[i], rows[i + half]) for i in range(half)]
        rows = [builder.shuffle_vector(*pair, order) for pair in pairs for order in (low, high)]
    return rows


def _row_access(builder, source, rows, width, first, count):
    """Addresses of columns ``[first : first + count]`` of sixteen rows, and a mask of ``count`` lanes."""
    i64, i32 = ir.IntType(64), ir.IntType(32)
    addresses = []
    for lane in range(LANES):
        row = builder.load(builder.gep(rows, [ir.Constant(i32, lane)]))
        index = builder.add(builder.mul(row, width), first)
        addresses.append(builder.gep(source, [index]))
    numbers = ir.Constant(ir.VectorType(i64, LANES), list(range(LANES)))
    one = builder.insert_element(ir.Constant(numbers.type, ir.Undefined), count, ir.Constant(i32, 0))
    many = builder.shuffle_vector(one, one, ir.Constant(INTEGERS, [0] * LANES))
    return addresses, builder.icmp_signed("<", numbers, many)


@intrinsic
def load_rows(typingctx, source, rows, width, first, count, lanes, at):
    """``lanes[at + k]`` = column ``first + k`` of sixteen rows of ``source [*, width]``, for k < count <= 16.

    ``rows`` points to their sixteen numbers (int64), ``lanes`` to vectors; those up to at + 15 are overwritten.
    """

    def codegen(context, builder, signature, args):
        source, rows, width, first, count, lanes, at = args
        addresses, mask = _row_access(builder, source, rows, width, first, count)
        found = [_masked(builder, "load", address, mask) for address in addresses]
        for k, vector in enumerate(_transposed(builder, found)):
            builder.store(vector, builder.gep(lanes, [builder.add(at, ir.Constant(ir.IntType(64), k))]), align=4)
        return context.get_dummy_value()

    i64 = types.int64
    return types.none(source, types.CPointer(i64), i64, i64, i64, types.CPointer(f32x16), i64), codegen


@intrinsic
def load_triples(typingctx, source, index, lanes):
    """``lanes[k]`` = column k of sixteen consecutive rows of ``source [*, 3]``, whose first element is ``index``."""
    offsets = [[3 * lane + k for lane in range(LANES)] for k in range(3)]

    def codegen(context, builder, signature, args):
        i64 = ir.IntType(64)
        at = [builder.gep(args[0], [builder.add(args[1], ir.Constant(i64, LANES * k))]) for k in range(3)]
        a, b, c = (builder.load(builder.bitcast(x, VECTOR.as_pointer()), align=4) for x in at)
        for k, order in enumerate(offsets):
            # Lanes of a and b first; those of c, from 32 on, take the places that are left.
            two = builder.shuffle_vector(a, b, ir.Constant(INTEGERS, [min(o, 2 * LANES - 1) for o in order]))
            rest = [lane if o < 2 * LANES else o - LANES for lane, o in enumerate(order)]
            column = builder.shuffle_vector(two, c, ir.Constant(INTEGERS, rest))
            builder.store(column, builder.gep(args[2], [ir.Constant(i64, k)]), align=4)
        return context.get_dummy_value()

    return types.none(source, types.int64, types.CPointer(f32x16)), codegen


@intrinsic
def store_rows(typingctx, destination, rows, width, first, count, lanes, at):
    """The inverse of ``load_rows``; of rows that are listed twice the last is stored."""

    def codegen(context, builder, signature, args):
        destination, rows, width, first, count, lanes, at = args
        addresses, mask = _row_access(builder, destination, rows, width, first, count)
        found = [
            builder.load(builder.gep(lanes, [builder.add(at, ir.Constant(ir.IntType(64), k))]), align=4)
            for k in range(LANES)
        ]
        for address, row in zip(addresses, _transposed(builder, found), strict=True):
            _masked(builder, "store", address, mask, row)
        return context.get_dummy_value()

    i64 = types.int64
    return types.none(destination, types.CPointer(i64), i64, i64, i64, types.CPointer(f32x16), i64), codegen


def _pairwise(builder, vectors):
    """Adds neighbouring lanes of up to 16 vectors until one vector holds all their sums, in order."""
    even, odd = range(0, 2 * LANES, 2), range(1, 2 * LANES, 2)
    while len(vectors) > 1:
        vectors = [*vectors, vectors[-1]] if len(vectors) % 2 else vectors
        vectors = [
            builder.fadd(*(builder.shuffle_vector(a, b, ir.Constant(INTEGERS, list(half))) for half in (even, odd)))
            for a, b in zip(vectors[::2], vectors[1::2], strict=True)
        ]
    return vectors[0]


@intrinsic
def store_sums(typingctx, array, index, a, b, c, d, e, f, g, h, i):
    """``array[index : index + 9]`` = the sums over the lanes of the nine vectors."""

    def codegen(context, builder, signature, args):
        sums = _pairwise(builder, list(args[2:]))
        data = data_of(context, builder, signature.args[0], args[0])
        pointer = builder.gep(data, [args[1]])
        eight = builder.shuffle_vector(sums, sums, ir.Constant(ir.VectorType(ir.IntType(32), 8), list(range(8))))
        builder.store(eight, builder.bitcast(pointer, eight.type.as_pointer()), align=4)
        ninth = builder.extract_element(sums, ir.Constant(ir.IntType(32), 8))
        builder.store(ninth, builder.gep(pointer, [ir.Constant(ir.IntType(64), 8)]))
        return context.get_dummy_value()

    return types.none(array, types.intp, *([f32x16] * 9)), codegen
