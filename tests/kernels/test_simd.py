"""Every vector operation against numpy, lane by lane."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from numba import float32, njit

from clod_adapter._kernels.bits import bits_of, lowest, set_spans
from clod_adapter._kernels.elementary import exp2, log2, vabs, vceil, vfloor, vsqrt
from clod_adapter._kernels.pointers import fetch_add, pointer
from clod_adapter._kernels.rows import store_sums
from clod_adapter._kernels.simd import anywhere, both, but_not, eq, fma, ge, gt, load, select, splat, store, vmax, vmin

LANES = 16


@njit
def every_operation(a, b, c, out):
    """Row k of ``out`` holds the result of the k-th operation of ``wanted``; masks as 1 and 0."""
    for at in range(0, len(a), LANES):
        x, y, z, s = load(a, at), load(b, at), load(c, at), b[at]
        one, zero = splat(float32(1)), splat(float32(0))
        total = difference = product = quotient = x
        total += y
        difference -= y
        product *= y
        quotient /= y
        shifted = lowered = scaled = divided = x
        shifted += s
        lowered -= s
        scaled *= s
        divided /= s
        results = (
            x + y, x - y, x * y, x / y, total, difference, product, quotient,
            x + s, x - s, x * s, x / s, shifted, lowered, scaled, divided, s + x, s - x, s * x, s / x,
            vmin(x, y), vmax(x, y), splat(a[at]), vsqrt(x), vfloor(x), vceil(x), vabs(x), -x,
            select(ge(x, y), one, zero), select(gt(x, y), one, zero), select(eq(x, y), one, zero),
            select(both(ge(x, y), gt(y, z)), one, zero), select(but_not(ge(x, y), gt(y, z)), one, zero), fma(x, y, z),
        )  # fmt: skip
        for k in range(len(results)):
            store(out[k], at, results[k])


def wanted(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> dict[str, np.ndarray]:
    """Comparisons with NaN are false; of ``min`` and ``max`` with NaN the result is the second operand."""
    s, first = (x.reshape(-1, LANES)[:, :1].repeat(LANES, 1).ravel() for x in (b, a))
    return {
        "+": a + b, "-": a - b, "*": a * b, "/": a / b, "+=": a + b, "-=": a - b, "*=": a * b, "/=": a / b,
        "+ s": a + s, "- s": a - s, "* s": a * s, "/ s": a / s, "+= s": a + s, "-= s": a - s, "*= s": a * s,
        "/= s": a / s, "s +": s + a, "s -": s - a, "s *": s * a, "s /": s / a,
        "min": np.where(a < b, a, b), "max": np.where(a > b, a, b), "splat": first,
        "sqrt": np.sqrt(a), "floor": np.floor(a), "ceil": np.ceil(a), "abs": np.abs(a), "neg": -a,
        "ge": a >= b, "gt": a > b, "eq": a == b, "ge and gt": (a >= b) & (b > c), "ge, not gt": (a >= b) & ~(b > c),
    }  # fmt: skip


def test_operations_match_numpy() -> None:
    """Random values, ties, zeros of both signs, tiny, huge, infinite values and NaN, in every combination."""
    rng = np.random.default_rng(0)
    special = [0.0, -0.0, 1.0, -1.0, 1e-38, 3e38, -3e38, np.inf, -np.inf, np.nan, 0.1, -0.9, 2.0**23 - 0.5, -(2.0**31)]
    grid = np.array(np.meshgrid(special, special, special)).reshape(3, -1)
    loose = np.concatenate([rng.normal(size=(3, 1000)), rng.integers(-2, 3, (3, 1000))], 1)
    values = np.concatenate([grid, loose], 1).astype(np.float32)
    a, b, c = (np.ascontiguousarray(v[: values.shape[1] // LANES * LANES]) for v in values)
    with np.errstate(all="ignore"):
        want = wanted(a, b, c)
        out = np.full((len(want) + 1, len(a)), -7, np.float32)
        every_operation(a, b, c, out)
        for (name, expected), found in zip(want.items(), out, strict=False):
            np.testing.assert_array_equal(found, expected.astype(np.float32), name)
        # fma is fused or not, as the processor can: within a rounding of the product.
        wide, product, found = a.astype(np.float64) * b + c, np.abs(a.astype(np.float64) * b), out[-1]
        close = np.abs(found.astype(np.float64) - wide) <= 2.0**-23 * (product + np.abs(wide)) + 2.0**-149
        close |= (found == wide.astype(np.float32)) | (np.isnan(found) & np.isnan(wide)) | (product > 3.4e38)
    assert close.all(), list(zip(a[~close], b[~close], c[~close], found[~close], strict=True))[:5]


@njit
def elementary(function, x, out):
    for at in range(0, len(x), LANES):
        store(out, at, exp2(load(x, at)) if function == 0 else log2(load(x, at)))


def exp2_of(x: np.ndarray) -> np.ndarray:
    padded = np.resize(x, -(-len(x) // LANES) * LANES)
    out = np.empty_like(padded)
    elementary(0, padded, out)
    return out[: len(x)]


def log2_of(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The logarithms, and those of numpy in float64, of ``x`` cut to whole vectors."""
    x = np.resize(x, -(-len(x) // LANES) * LANES)
    found = np.empty_like(x)
    elementary(1, x, found)
    return found, np.log2(x.astype(np.float64))


def test_exp2_has_a_relative_error_below_3e_7() -> None:
    """Two to three units in the last place, over what blending needs, [-126, 0], and above."""
    below = np.concatenate([np.linspace(-126, 0, 1_000_001), -np.logspace(-30, 2.1, 100_001)]).astype(np.float32)
    for x in (below[below >= -126], np.linspace(0, 127, 100_001).astype(np.float32)):
        want = np.exp2(x.astype(np.float64))
        assert (np.abs(exp2_of(x) - want) / want).max() < 3e-7


def test_exp2_is_exact_at_integers_and_monotonic() -> None:
    """It is clamped to the smallest normal number, and rises with its argument up to its last digits."""
    whole = np.arange(-126, 128, dtype=np.float32)
    np.testing.assert_array_equal(exp2_of(whole), np.ldexp(np.float32(1), whole.astype(int)))
    low = np.array([-126.0, -126.0001, -127.5, -1000.0, -1e30, -np.inf, np.nan], np.float32)
    np.testing.assert_array_equal(exp2_of(low), np.full(len(low), 2.0**-126, np.float32))
    found = exp2_of(np.linspace(-9, 0, 400_001).astype(np.float32)).astype(np.float64)
    assert (np.diff(found) >= -4e-7 * found[1:]).all()


def test_log2_has_an_absolute_error_below_1e_7() -> None:
    """In addition to one and a half units of the result (tests/other_libm); for every mantissa of two octaves, and all
    normal exponents."""
    octaves = np.float32(0.5).view(np.uint32) + np.arange(1 << 24, dtype=np.uint32)
    every = np.arange(0x00800000, np.float32(3.4e38).view(np.uint32), 997, dtype=np.uint32)
    ends = np.array([2.0**-126, 3e38, np.finfo(np.float32).max], np.float32)
    for x in (octaves.view(np.float32), np.concatenate([ends, every.view(np.float32)])):
        found, want = log2_of(x)
        rounding = np.spacing(np.abs(want).astype(np.float32)) * 1.5
        assert (np.abs(found - want) - rounding).max() < 1e-7


def test_log2_is_exact_at_powers_of_two_and_accurate_near_1() -> None:
    whole = np.arange(-126, 128)
    found, _ = log2_of(np.ldexp(np.float32(1), whole))
    np.testing.assert_array_equal(found[: len(whole)], whole)
    bits = np.float32(1).view(np.uint32) + np.delete(np.arange(-2000, 2000, dtype=np.int64), 2000)
    found, want = log2_of(bits.astype(np.uint32).view(np.float32))
    assert (np.abs(found / want - 1)).max() < 3e-7


@njit
def spans(low, high, words, index, rows):
    if rows == 8:
        set_spans(pointer(words), index, load(low, 0), load(high, 0), 8)
    else:
        set_spans(pointer(words), index, load(low, 0), load(high, 0), 16)


def assert_spans(low: np.ndarray, high: np.ndarray, rows: int, index: int = 0) -> None:
    """The spans of the first ``rows`` lanes are set, and no other words are written."""
    low, high = (np.asarray(x, np.float32) for x in (low, high))
    found = np.full(index + rows * rows // 64 + 2, 0xA5A5, np.uint64)
    want, bits = found.copy(), 0
    for r in range(rows):
        for k in range(int(low[r]), int(high[r]) + 1):
            bits |= 1 << (rows * r + k)
    for word in range(rows * rows // 64):
        want[index + word] = (bits >> (64 * word)) & (2**64 - 1)
    spans(low, high, found, index, rows)
    np.testing.assert_array_equal(found, want)


@pytest.mark.parametrize("rows", [8, 16])
def test_spans(rows: int) -> None:
    """Every span in every row, including empty ones (high < low) and ones right of the tile; then mixed rows."""
    for low in range(rows):
        for high in range(-1, rows):
            assert_spans(np.full(LANES, low), np.full(LANES, high), rows)
            for row in range(LANES):  # alone; of 8 rows, lanes from 8 on belong to none
                alone = np.where(np.arange(LANES) == row, high, -1)
                assert_spans(np.full(LANES, low), alone, rows)
    for low in (rows, 31, 32, 33, 64, 1000, 1e9):
        for high in (-1, -40, rows - 1):
            assert_spans(np.full(LANES, low), np.full(LANES, high), rows)
    rng = np.random.default_rng(0)
    for k in range(400):
        low, high = rng.integers(0, rows, LANES), rng.integers(-1, rows, LANES)
        assert_spans(low, high, rows, k % 8)
        assert_spans(low + rng.uniform(0, 0.999, LANES), high + rng.uniform(0, 0.999, LANES) * (high >= 0), rows, k % 8)


@njit
def of_a_mask(a, b):
    mask = gt(load(a, 0), load(b, 0))
    return bits_of(mask), anywhere(mask)


@njit
def lowest_of(bits):
    return lowest(bits)


def test_bits_of_masks_and_lowest_bits() -> None:
    rng = np.random.default_rng(0)
    for pattern in (0, 2**LANES - 1, *(1 << k for k in range(LANES)), *rng.integers(0, 2**16, 100)):
        lanes = (int(pattern) >> np.arange(LANES) & 1).astype(np.float32)
        assert of_a_mask(lanes, np.zeros(LANES, np.float32)) == (pattern, pattern != 0)
    for k in range(64):
        for above in (0, 2**64 - 1, *rng.integers(0, 2**64, 5, dtype=np.uint64)):
            assert lowest_of(np.uint64(int(above) >> k << k | 1 << k)) == k


@njit
def sums(v, out, index):
    store_sums(
        out, index, load(v[0], 0), load(v[1], 0), load(v[2], 0), load(v[3], 0), load(v[4], 0), load(v[5], 0),
        load(v[6], 0), load(v[7], 0), load(v[8], 0),
    )  # fmt: skip


def test_store_sums() -> None:
    """Nine sums in order, added pairwise with four roundings each; no other element is written."""
    rng = np.random.default_rng(0)
    for index in (0, 9, 11):
        vectors = rng.integers(-1000, 1000, (9, LANES)).astype(np.float32)  # whole numbers: exact in any order
        out, want = (np.full(32, -0.5, np.float32) for _ in range(2))
        sums(vectors, out, index)
        want[index : index + 9] = vectors.sum(1)
        np.testing.assert_array_equal(out, want)
    vectors, out = rng.normal(size=(9, LANES)).astype(np.float32), np.empty(9, np.float32)
    sums(vectors, out, 0)
    wide = vectors.astype(np.float64)
    assert (np.abs(out - wide.sum(1)) <= 4 * 2.0**-24 * np.abs(wide).sum(1)).all()


@njit(nogil=True)
def take_numbers(counter, amount, out):
    for i in range(len(out)):
        out[i] = fetch_add(counter, amount)


@pytest.mark.parametrize("amount", [1, 3])
def test_fetch_add_gives_each_number_once(amount: int, count: int = 200_000) -> None:
    """With two concurrent threads."""
    counter, taken, together = np.zeros(1, np.int64), np.full((2, count), -1, np.int64), threading.Barrier(2)
    take_numbers(counter, amount, np.empty(0, np.int64))  # compiled

    def work(k: int) -> None:
        together.wait()
        take_numbers(counter, amount, taken[k])

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counter[0] == 2 * count * amount and (np.diff(taken) > 0).all()
    np.testing.assert_array_equal(np.sort(taken.ravel()), amount * np.arange(2 * count))
