"""Transposes of sixteen rows of a matrix to vectors with one lane per row, and back."""

from __future__ import annotations

import ctypes
import mmap
import os

import numpy as np
import pytest
from numba import njit

from clod_adapter._kernels.pointers import pointer, scratch
from clod_adapter._kernels.rows import load_rows, store_rows
from clod_adapter._kernels.simd import f32x16, load, store

LANES, VECTORS = 16, 40
WIDTHS = [3, 4, 9, 16, 45, 72]
# Width, first column, number of columns.
SPANS = [
    (width, first, count)
    for width in WIDTHS
    for count in range(1, LANES + 1)
    for first in {0, 1, (width - count) // 2, width - count}
    if 0 <= first <= width - count
]
CONSTANTS = [(1, 0, 1), (3, 0, 3), (4, 0, 4), (16, 0, 16), (16, 6, 3), (9, 1, 8), (45, 32, 13), (72, 16, 16)]


@njit
def to_vectors(source, rows, width, first, count, lanes, at):
    """Initialises the vectors from ``lanes [VECTORS, 16]``, so that unwritten vectors are visible."""
    vectors = scratch(f32x16, VECTORS)
    for k in range(VECTORS):
        vectors[k] = load(lanes[k], 0)
    load_rows(pointer(source), pointer(rows), width, first, count, vectors, at)
    for k in range(VECTORS):
        store(lanes[k], 0, vectors[k])


@njit
def to_rows(destination, rows, width, first, count, lanes, at):
    vectors = scratch(f32x16, VECTORS)
    for k in range(VECTORS):
        vectors[k] = load(lanes[k], 0)
    store_rows(pointer(destination), pointer(rows), width, first, count, vectors, at)


def matrix(rows: int, width: int) -> np.ndarray:
    return np.arange(1, rows * width + 1, dtype=np.float32).reshape(rows, width)


def island(size: int, at_the_end: bool) -> np.ndarray:
    """A float32 array next to protected memory, behind or before it: an access beyond that end kills the process."""
    pages = -(-4 * size // mmap.PAGESIZE)
    whole = mmap.mmap(-1, (pages + 2) * mmap.PAGESIZE)
    address, end = ctypes.addressof(ctypes.c_char.from_buffer(whole)), (pages + 1) * mmap.PAGESIZE
    for guard in (address, address + end):
        assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(guard), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
    return np.frombuffer(whole, np.float32, size, end - 4 * size if at_the_end else mmap.PAGESIZE)


ORDERS = {
    "in order": np.arange(LANES),
    "backwards": np.arange(LANES)[::-1],
    "apart": np.arange(LANES) * 3 % 50,
    "the last": np.full(LANES, 49),
    "padded": np.minimum(np.arange(LANES), 5) + 44,
    "mixed": np.random.default_rng(0).integers(0, 50, LANES),
}


@pytest.mark.parametrize("width", WIDTHS)
def test_load_and_store_rows(width: int) -> None:
    """Other vectors and columns are not written; the last lane of a repeated row is stored."""
    source, stored = matrix(50, width), -matrix(VECTORS, LANES)
    for rows in (order.astype(np.int64) for order in ORDERS.values()):
        for turn, (_, first, count) in enumerate(s for s in SPANS if s[0] == width):
            at, last = (0, 7, VECTORS - LANES)[turn % 3], first + count
            lanes = np.full((VECTORS, LANES), -1, np.float32)
            to_vectors(source, rows, width, first, count, lanes, at)
            np.testing.assert_array_equal(lanes[at : at + count], source[rows, first:last].T)
            assert (lanes[:at] == -1).all() and (lanes[at + LANES :] == -1).all()
            found, want = matrix(50, width), matrix(50, width)
            for lane, row in enumerate(rows):
                want[row, first:last] = stored[at : at + count, lane]
            to_rows(found, rows, width, first, count, stored, at)
            np.testing.assert_array_equal(found, want)


@pytest.mark.skipif(os.name != "posix", reason="needs mprotect")
@pytest.mark.parametrize(("width", "first", "count"), CONSTANTS)
def test_constant_columns(width: int, first: int, count: int) -> None:
    """Compiled for constant columns, as in the kernels, and without access beyond the array."""

    @njit
    def load_constant(source, rows, lanes):
        vectors = scratch(f32x16, VECTORS)
        load_rows(pointer(source), pointer(rows), width, first, count, vectors, 2)
        for k in range(count):
            store(lanes[k], 0, vectors[2 + k])

    @njit
    def store_constant(destination, rows, lanes):
        vectors = scratch(f32x16, VECTORS)
        for k in range(LANES):
            vectors[2 + k] = load(lanes[k], 0)
        store_rows(pointer(destination), pointer(rows), width, first, count, vectors, 2)

    for at_the_end in (True, False):
        array = island(50 * width, at_the_end)
        for rows in (order.astype(np.int64) for order in (*ORDERS.values(), np.arange(34, 50))):
            lanes, stored, want = np.zeros((LANES, LANES), np.float32), -matrix(LANES, LANES), matrix(50, width)
            array[:] = want.ravel()
            load_constant(array, rows, lanes)
            np.testing.assert_array_equal(lanes[:count], want[rows, first : first + count].T)
            for lane, row in enumerate(rows):
                want[row, first : first + count] = stored[:count, lane]
            store_constant(array, rows, stored)
            np.testing.assert_array_equal(array.reshape(50, width), want)


def test_all_bit_patterns_pass_and_zero_columns_do_nothing() -> None:
    """NaN payloads, infinities, -0 and subnormal numbers are kept; a count of 0 is that of SH degree 0."""
    bits = np.random.default_rng(0).integers(0, 2**32, (LANES, 9), dtype=np.uint32)
    bits[:, :5] = np.array([0x7FC12345, 0xFF800000, 0x80000000, 1, 0x7F800001], np.uint32)
    source, back = bits.view(np.float32), np.zeros((LANES, 9), np.float32)
    rows, lanes = np.arange(LANES), np.ones((VECTORS, LANES), np.float32)
    to_vectors(source, rows, 9, 0, 9, lanes, 0)
    to_rows(back, rows, 9, 0, 9, lanes, 0)
    np.testing.assert_array_equal(back.view(np.uint32), bits)
    to_rows(back, rows, 9, 0, 0, lanes, 0)
    to_vectors(back, rows, 9, 0, 0, lanes, 0)
    np.testing.assert_array_equal(back.view(np.uint32), bits)
    assert (lanes[LANES:] == 1).all()
