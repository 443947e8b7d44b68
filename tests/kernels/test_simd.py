"""Every vector operation against numpy, lane by lane."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from numba import float32, njit

from clod_adapter._kernels import simd
from clod_adapter._kernels.simd import (
    anywhere,
    both,
    but_not,
    exp2,
    fetch_add,
    fma,
    ge,
    gt,
    load,
    select,
    splat,
    store,
    store_sums,
    vmin,
)

LANES = 16
NAMES = ("add", "sub", "mul", "div", "fma", "min", "ge", "gt", "ge and gt b c", "ge, not gt b c", "splat")


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


@pytest.fixture(scope="module")
def operands() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random values, ties, zeros of both signs, tiny, huge and infinite ones, in every combination."""
    rng = np.random.default_rng(0)
    special = np.array([0.0, -0.0, 1.0, -1.0, 1e-38, 3e38, -3e38, np.inf, -np.inf, 0.1], np.float32)
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


@njit
def lane_masks(a, b, out):
    out[0] = anywhere(gt(load(a, 0), load(b, 0)))


@pytest.mark.parametrize("lanes", [(), *((k,) for k in range(LANES)), tuple(range(LANES))], ids=str)
def test_anywhere(lanes: tuple[int, ...]) -> None:
    a, out = np.zeros(LANES, np.float32), np.zeros(1, np.uint8)
    a[list(lanes)] = 1
    lane_masks(a, np.zeros(LANES, np.float32), out)
    assert out[0] == bool(lanes)


def test_comparisons_with_nan_are_false_and_the_other_operand_wins(lanes: int = LANES) -> None:
    nan, one = np.full(lanes, np.nan, np.float32), np.ones(lanes, np.float32)
    out = np.empty((len(NAMES), lanes), np.float32)
    every_operation(nan, one, one, out)
    for name in ("ge", "gt"):
        assert (out[NAMES.index(name)] == 0).all()
    # A NaN alpha becomes the bound it is compared with.
    for name in ("min",):
        assert (out[NAMES.index(name)] == 1).all()


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
