"""Every vector operation against numpy, lane by lane."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from numba import float32, njit

from clod_adapter._kernels import simd
from clod_adapter._kernels.bits import bits_of, lowest, set_spans
from clod_adapter._kernels.elementary import exp2, log2, vabs, vceil, vfloor, vsqrt
from clod_adapter._kernels.pointers import fetch_add, pointer, prefetch
from clod_adapter._kernels.rows import store_sums
from clod_adapter._kernels.simd import anywhere, both, but_not, eq, fma, ge, gt, load, select, splat, store, vmax, vmin

LANES = 16
NAMES = (
    "add", "sub", "mul", "div", "fma", "min", "ge", "gt", "ge and gt b c", "ge, not gt b c", "splat",
    "max", "eq", "sqrt", "floor", "ceil", "abs", "neg",
)  # fmt: skip


@njit
def every_operation(a, b, c, out):
    """Row k of ``out`` holds the result of NAMES[k]; masks as 1 and 0."""
    for at in range(0, len(a), LANES):
        x, y, z = load(a, at), load(b, at), load(c, at)
        one, zero = splat(float32(1)), splat(float32(0))
        store(out[0], at, x + y)
        store(out[1], at, x - y)
        store(out[2], at, x * y)
        store(out[3], at, x / y)
        store(out[4], at, fma(x, y, z))
        store(out[5], at, vmin(x, y))
        store(out[6], at, select(ge(x, y), one, zero))
        store(out[7], at, select(gt(x, y), one, zero))
        store(out[8], at, select(both(ge(x, y), gt(y, z)), one, zero))
        store(out[9], at, select(but_not(ge(x, y), gt(y, z)), one, zero))
        store(out[10], at, splat(a[at]))
        store(out[11], at, vmax(x, y))
        store(out[12], at, select(eq(x, y), one, zero))
        store(out[13], at, vsqrt(x))
        store(out[14], at, vfloor(x))
        store(out[15], at, vceil(x))
        store(out[16], at, vabs(x))
        store(out[17], at, -x)


@pytest.fixture(scope="module")
def operands() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random values, ties, zeros of both signs, tiny, huge and infinite ones, in every combination."""
    rng = np.random.default_rng(0)
    special = [0.0, -0.0, 1.0, -1.0, 1e-38, 3e38, -3e38, np.inf, -np.inf, 0.1, -0.9, 2.0**23 - 0.5, -(2.0**31)]
    special = np.array(special, np.float32)
    grid = np.array(np.meshgrid(special, special, special)).reshape(3, -1)
    loose = np.concatenate([rng.normal(size=(3, 1000)), rng.integers(-2, 3, (3, 1000))], 1)
    values = np.concatenate([grid, loose], 1).astype(np.float32)
    return tuple(np.ascontiguousarray(v[: values.shape[1] // LANES * LANES]) for v in values)


@pytest.fixture(scope="module")
def results(operands: tuple[np.ndarray, ...]) -> dict[str, np.ndarray]:
    out = np.full((len(NAMES), len(operands[0])), -7, np.float32)
    every_operation(*operands, out)
    return dict(zip(NAMES, out, strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_is_numpy_s(operands: tuple[np.ndarray, ...], results: dict[str, np.ndarray], name: str) -> None:
    a, b, c = operands
    with np.errstate(all="ignore"):
        wide = a.astype(np.float64) * b + c
        want = {
            "add": a + b, "sub": a - b, "mul": a * b, "div": a / b, "fma": wide.astype(np.float32),
            "min": np.where(a < b, a, b), "ge": a >= b, "gt": a > b,
            "ge and gt b c": (a >= b) & (b > c), "ge, not gt b c": (a >= b) & ~(b > c),
            "splat": a.reshape(-1, LANES)[:, :1].repeat(LANES, 1).ravel(),
            "max": np.where(a > b, a, b), "eq": a == b, "sqrt": np.sqrt(a), "floor": np.floor(a), "ceil": np.ceil(a),
            "abs": np.abs(a), "neg": -a,
        }[name].astype(np.float32)  # fmt: skip
    found = results[name]
    if name == "fma":  # fused or not, as the processor can: within a rounding of the product
        with np.errstate(all="ignore"):
            product = np.abs(a.astype(np.float64) * b)
            close = np.abs(found.astype(np.float64) - wide) <= 2.0**-23 * (product + np.abs(wide)) + 2.0**-149
        close |= (found == want) | (np.isnan(found) & np.isnan(want)) | (product > 3.4e38)
        assert close.all(), list(zip(a[~close], b[~close], c[~close], found[~close], strict=True))[:5]
    else:
        np.testing.assert_array_equal(found, want)


MIXED = ("v + s", "s + v", "v - s", "s - v", "v * s", "s * v", "v / s", "s / v", "+=", "-=", "*=", "/=")


@njit
def mixed_operations(a, b, out):
    """Row k of ``out`` holds MIXED[k] of sixteen of a and the first of sixteen of b."""
    for at in range(0, len(a), LANES):
        v, s = load(a, at), b[at]
        store(out[0], at, v + s)
        store(out[1], at, s + v)
        store(out[2], at, v - s)
        store(out[3], at, s - v)
        store(out[4], at, v * s)
        store(out[5], at, s * v)
        store(out[6], at, v / s)
        store(out[7], at, s / v)
        summed = difference = product = quotient = v
        summed += s
        difference -= s
        product *= s
        quotient /= s
        store(out[8], at, summed)
        store(out[9], at, difference)
        store(out[10], at, product)
        store(out[11], at, quotient)


def test_vector_and_number(operands: tuple[np.ndarray, ...]) -> None:
    a, b, _ = operands
    b = np.random.default_rng(1).permutation(b)
    found = np.full((len(MIXED), len(a)), -7, np.float32)
    mixed_operations(a, b, found)
    s = b[::LANES].repeat(LANES)
    with np.errstate(all="ignore"):
        once = [a + s, s + a, a - s, s - a, a * s, s * a, a / s, s / a]
        want = np.stack([*once, a + s, a - s, a * s, a / s])
    for name, x, y in zip(MIXED, found, want, strict=True):
        np.testing.assert_array_equal(x, y, name)


@njit
def in_place(a, b, out):
    x, kept = load(a, 0), load(a, 0)
    x += load(b, 0)
    store(out[0], 0, x)
    x -= load(a, 0)
    store(out[1], 0, x)
    x *= load(a, 0)
    store(out[2], 0, x)
    x /= load(b, 0)
    store(out[3], 0, x)
    store(out[4], 0, kept)


def test_assignments_make_a_new_vector() -> None:
    a, out = np.arange(1, LANES + 1, dtype=np.float32), np.empty((5, LANES), np.float32)
    in_place(a, 2 * a, out)
    np.testing.assert_array_equal(out, [3 * a, 2 * a, 2 * a * a, a, a])


@njit
def lane_masks(a, b, out):
    out[0] = anywhere(gt(load(a, 0), load(b, 0)))


@pytest.mark.parametrize("lanes", [(), *((k,) for k in range(LANES)), tuple(range(LANES))], ids=str)
def test_anywhere(lanes: tuple[int, ...]) -> None:
    a, out = np.zeros(LANES, np.float32), np.zeros(1, np.uint8)
    a[list(lanes)] = 1
    lane_masks(a, np.zeros(LANES, np.float32), out)
    assert out[0] == bool(lanes)


def test_comparisons_with_nan_are_false_and_the_second_operand_wins(lanes: int = LANES) -> None:
    nan, one = np.full(lanes, np.nan, np.float32), np.ones(lanes, np.float32)
    for a, b in ((nan, one), (one, nan), (nan, nan)):
        out = np.empty((len(NAMES), lanes), np.float32)
        every_operation(a, b, one, out)
        for name in ("ge", "gt", "eq"):
            assert (out[NAMES.index(name)] == 0).all(), name
        # A NaN alpha becomes the bound it is compared with.
        for name in ("min", "max"):
            np.testing.assert_array_equal(out[NAMES.index(name)], b, name)


def test_nan_stays_nan(lanes: int = LANES) -> None:
    nan, one = np.full(lanes, np.nan, np.float32), np.ones(lanes, np.float32)
    out = np.empty((len(NAMES), lanes), np.float32)
    every_operation(nan, one, one, out)
    for name in ("add", "sub", "mul", "div", "fma", "sqrt", "floor", "ceil", "abs", "neg"):
        assert np.isnan(out[NAMES.index(name)]).all(), name


@njit
def move(a, source, out, target):
    store(out, target, load(a, source))


@pytest.mark.parametrize(("source", "target"), [(0, 0), (1, 3), (7, 16), (21, 5)])
def test_load_and_store_take_any_offset(source: int, target: int) -> None:
    a, out = np.arange(40, dtype=np.float32), np.full(40, -1, np.float32)
    move(a, source, out, target)
    want = np.full(40, -1, np.float32)
    want[target : target + LANES] = a[source : source + LANES]
    np.testing.assert_array_equal(out, want)


@njit
def powers(x, out):
    for at in range(0, len(x), LANES):
        store(out, at, exp2(load(x, at)))


def exp2_of(x: np.ndarray) -> np.ndarray:
    padded = np.zeros(-(-len(x) // LANES) * LANES, np.float32)
    padded[: len(x)] = x
    out = np.empty_like(padded)
    powers(padded, out)
    return out[: len(x)]


def test_exp2_over_what_blending_needs() -> None:
    """Relative error below 3e-7 (two to three units in the last place) over [-126, 0], and 1 at 0 exactly."""
    x = np.concatenate([np.linspace(-126, 0, 1_000_001), -np.logspace(-30, 2.1, 100_001)]).astype(np.float32)
    x = x[x >= -126]
    want = np.exp2(x.astype(np.float64))
    assert (np.abs(exp2_of(x) - want) / want).max() < 3e-7
    assert exp2_of(np.zeros(1, np.float32))[0] == 1


def test_exp2_at_whole_numbers_and_above_zero() -> None:
    whole = np.arange(-126, 128, dtype=np.float32)
    np.testing.assert_array_equal(exp2_of(whole), np.ldexp(np.float32(1), whole.astype(int)))
    x = np.linspace(0, 127, 100_001).astype(np.float32)
    want = np.exp2(x.astype(np.float64))
    assert (np.abs(exp2_of(x) - want) / want).max() < 3e-7


def test_exp2_ends_at_the_smallest_normal_number() -> None:
    below = np.array([-126.0, -126.0001, -127.5, -1000.0, -1e30, -np.inf, np.nan], np.float32)
    np.testing.assert_array_equal(exp2_of(below), np.full(len(below), 2.0**-126, np.float32))


def test_exp2_never_rises_where_its_argument_falls() -> None:
    """Up to its last digits, over a fine grid: a blended edge must not ripple."""
    x = np.linspace(-9, 0, 400_001).astype(np.float32)
    found = exp2_of(x).astype(np.float64)
    assert (np.diff(found) >= -4e-7 * found[1:]).all()


@njit
def logarithms(x, out):
    for at in range(0, len(x), LANES):
        store(out, at, log2(load(x, at)))


def log2_error(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Difference from the true logarithm, and half a unit in its last place as float32."""
    x = np.resize(x, -(-len(x) // LANES) * LANES)
    found, want = np.empty_like(x), np.log2(x.astype(np.float64))
    logarithms(x, found)
    return np.abs(found - want), np.spacing(np.abs(want).astype(np.float32)) / 2


def test_log2_of_every_mantissa() -> None:
    """Absolute error 1e-7 beside the rounding of the result, over the two octaves around 1."""
    for first in (0.5, 1.0):
        bits = np.float32(first).view(np.uint32) + np.arange(1 << 23, dtype=np.uint32)
        error, rounding = log2_error(bits.view(np.float32))
        assert (error - rounding).max() < 1e-7


def test_log2_of_opacities() -> None:
    """What a record holds: over [1/255, 1] off by at most 1e-7 and its own rounding."""
    error, rounding = log2_error(np.linspace(1 / 255, 1, 4_000_000).astype(np.float32))
    assert (error - rounding).max() < 1e-7


def test_log2_of_all_normal_numbers() -> None:
    bits = np.arange(0x00800000, np.float32(3.4e38).view(np.uint32), 997, dtype=np.uint32)
    ends = np.array([2.0**-126, 3e38, np.finfo(np.float32).max], np.float32)
    error, rounding = log2_error(np.concatenate([ends, bits.view(np.float32)]))
    assert (error - rounding).max() < 1e-7


def test_log2_of_powers_of_two_is_exact() -> None:
    """0 at 1 among them."""
    whole = np.arange(-126, 128)
    x = np.resize(np.ldexp(np.float32(1), whole), 256)
    found = np.empty_like(x)
    logarithms(x, found)
    np.testing.assert_array_equal(found[: len(whole)], whole)


def test_log2_near_1_is_relatively_exact() -> None:
    """Where its own rounding is the smallest: nothing cancels."""
    bits = np.float32(1).view(np.uint32) + np.arange(-2000, 2000, dtype=np.int64)
    x = bits[bits != np.float32(1).view(np.uint32)].astype(np.uint32).view(np.float32)
    x = np.resize(x, len(x) // LANES * LANES)
    found = np.empty_like(x)
    logarithms(x, found)
    want = np.log2(x.astype(np.float64))
    assert (np.abs(found / want - 1)).max() < 3e-7


@njit
def spans_of_8(low, high, words, index):
    set_spans(pointer(words), index, load(low, 0), load(high, 0), 8)


@njit
def spans_of_16(low, high, words, index):
    set_spans(pointer(words), index, load(low, 0), load(high, 0), 16)


def spans_by_hand(low: np.ndarray, high: np.ndarray, rows: int) -> np.ndarray:
    bits = 0
    for r in range(rows):
        for k in range(int(low[r]), int(high[r]) + 1):
            bits |= 1 << (rows * r + k)
    return np.array([(bits >> (64 * word)) & (2**64 - 1) for word in range(rows * rows // 64)], np.uint64)


def assert_spans(low: np.ndarray, high: np.ndarray, rows: int, index: int = 0) -> None:
    """The spans of the first lanes alone, and nothing beside the words that are theirs."""
    low, high = (np.asarray(x, np.float32) for x in (low, high))
    found = np.full(index + rows * rows // 64 + 2, 0xA5A5, np.uint64)
    want = found.copy()
    want[index : index + rows * rows // 64] = spans_by_hand(low, high, rows)
    (spans_of_8 if rows == 8 else spans_of_16)(low, high, found, index)
    np.testing.assert_array_equal(found, want)


@pytest.mark.parametrize("rows", [8, 16])
def test_every_span_in_every_row(rows: int) -> None:
    """From the first bit to the last, empty ones (high < low) among them."""
    for low in range(rows):
        for high in range(-1, rows):
            assert_spans(np.full(LANES, low), np.full(LANES, high), rows)
            for row in range(LANES):  # alone; of 8 rows, lanes from 8 on belong to none
                alone = np.where(np.arange(LANES) == row, high, -1)
                assert_spans(np.full(LANES, low), alone, rows)


@pytest.mark.parametrize("index", [0, 1, 4, 7])
@pytest.mark.parametrize("rows", [8, 16])
def test_spans_of_different_rows(rows: int, index: int) -> None:
    rng = np.random.default_rng(index)
    for _ in range(200):
        low, high = rng.integers(0, rows, LANES), rng.integers(-1, rows, LANES)
        assert_spans(low, high, rows, index)
        assert_spans(low + rng.uniform(0, 0.999, LANES), high + rng.uniform(0, 0.999, LANES) * (high >= 0), rows, index)


@pytest.mark.parametrize("rows", [8, 16])
def test_spans_beyond_the_row_are_empty_where_high_is_less(rows: int) -> None:
    """As a Gaussian right of the tile gives them."""
    for low in (rows, 31, 32, 33, 64, 1000, 1e9):
        for high in (-1, -40, rows - 1):
            assert_spans(np.full(LANES, low), np.full(LANES, high), rows)


@njit
def mask_bits(a, b):
    return bits_of(gt(load(a, 0), load(b, 0)))


def test_bits_of() -> None:
    zeros = np.zeros(LANES, np.float32)
    patterns = [0, 2**LANES - 1, *(1 << k for k in range(LANES)), *np.random.default_rng(0).integers(0, 2**16, 100)]
    for pattern in patterns:
        lanes = (int(pattern) >> np.arange(LANES) & 1).astype(np.float32)
        assert mask_bits(lanes, zeros) == pattern


@njit
def lowest_of(bits):
    return lowest(bits)


def test_lowest() -> None:
    rng = np.random.default_rng(0)
    for k in range(64):
        for above in (0, 2**64 - 1, *rng.integers(0, 2**64, 5, dtype=np.uint64)):
            assert lowest_of(np.uint64(int(above) >> k << k | 1 << k)) == k


@njit
def prefetch_all(array):
    p = pointer(array)
    for i in range(len(array)):
        prefetch(array, i)
        prefetch(p, i)


@pytest.mark.parametrize("dtype", [np.float32, np.int32, np.uint64])
def test_prefetch_changes_nothing(dtype: type) -> None:
    array = np.arange(1000, dtype=dtype)
    prefetch_all(array)
    np.testing.assert_array_equal(array, np.arange(1000, dtype=dtype))


@njit
def sums(vectors, out, index):
    store_sums(
        out, index, load(vectors[0], 0), load(vectors[1], 0), load(vectors[2], 0), load(vectors[3], 0),
        load(vectors[4], 0), load(vectors[5], 0), load(vectors[6], 0), load(vectors[7], 0), load(vectors[8], 0),
    )  # fmt: skip


@pytest.mark.parametrize("index", [0, 9, 11])
def test_store_sums_keeps_the_order(index: int) -> None:
    """Nine sums in the order given, and nothing beside them is written."""
    rng = np.random.default_rng(index)
    vectors = rng.integers(-1000, 1000, (9, LANES)).astype(np.float32)  # whole numbers: exact in any order
    out = np.full(32, -0.5, np.float32)
    sums(vectors, out, index)
    want = np.full(32, -0.5, np.float32)
    want[index : index + 9] = vectors.sum(1)
    np.testing.assert_array_equal(out, want)


def test_store_sums_rounds_like_a_tree() -> None:
    """Pairwise: four roundings on the way, not fifteen."""
    vectors = np.random.default_rng(0).normal(size=(9, LANES)).astype(np.float32)
    out = np.empty(9, np.float32)
    sums(vectors, out, 0)
    wide = vectors.astype(np.float64)
    assert (np.abs(out - wide.sum(1)) <= 4 * 2.0**-24 * np.abs(wide).sum(1)).all()


@njit(nogil=True)
def take_numbers(counter, amount, out):
    for i in range(len(out)):
        out[i] = fetch_add(counter, amount)


@pytest.mark.parametrize("amount", [1, 3])
def test_fetch_add_gives_each_number_once(amount: int, count: int = 200_000) -> None:
    """Under two threads that run at the same time."""
    counter = np.zeros(1, np.int64)
    taken = np.full((2, count), -1, np.int64)
    take_numbers(counter, amount, np.empty(0, np.int64))  # compiled
    together = threading.Barrier(2)

    def work(k: int) -> None:
        together.wait()
        take_numbers(counter, amount, taken[k])

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counter[0] == 2 * count * amount
    np.testing.assert_array_equal(np.sort(taken.ravel()), amount * np.arange(2 * count))
    assert (np.diff(taken) > 0).all()


def test_sixteen_lanes() -> None:
    assert simd.LANES == LANES
