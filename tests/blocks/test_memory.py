"""Memory plans, and the sizes that --memory accepts."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clod_adapter.blocks.memory import MOST_BLOCKS, MemoryEstimate, in_words, least, parse_size, plan_for_limit
from clod_adapter.errors import ClodError

CITY = MemoryEstimate(2_000_000, 236, 248, 60 * 960 * 540 * 3, 960 * 540)


SIZES = {
    "8GB": 8 * 10**9, "8 gb": 8 * 10**9, "8G": 8 * 10**9, "500MB": 5 * 10**8, "0.5GB": 5 * 10**8, ".5G": 5 * 10**8,
    "7.5GiB": 15 * 2**29, "16gib": 2**34, "1T": 10**12, "64000K": 64 * 10**6,
}  # fmt: skip


def test_sizes() -> None:
    assert {text: parse_size(text) for text in SIZES} == SIZES
    for text in ("", "8", "GB", "8 XB", "-8GB", "8GBs", "eight", "1e3GB", "0GB", "8..GB", "9999999T"):
        with pytest.raises(ClodError, match="--memory is .*8GB"):
            parse_size(text)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 10**7), st.sampled_from([56, 236]), st.integers(0, 10**10), st.integers(1, 10**7))
def test_least_memory_is_the_smallest_that_suffices(count: int, attributes: int, images: int, pixels: int) -> None:
    needs = MemoryEstimate(count, attributes, attributes + 12, images, pixels)
    limit = least(needs)
    plan = plan_for_limit(needs, limit)
    assert plan.peak <= limit and 1 <= plan.blocks <= min(count, MOST_BLOCKS)
    if limit > 10**8:
        with pytest.raises(ClodError, match="take at least .* give that"):
            plan_for_limit(needs, limit - 10**8)


def test_too_little_memory_names_the_least() -> None:
    """The least that the error names suffices; it has four digits where three would round down."""
    with pytest.raises(ClodError) as error:
        plan_for_limit(CITY, 10**9)
    assert f"--memory is 1 GB, and 2,000,000 Gaussians take at least {in_words(least(CITY))}" in str(error.value)
    for count in (CITY.count, 90_000_000, 91_234_567, 1_000_000_000):
        needs = replace(CITY, count=count)
        assert plan_for_limit(needs, parse_size(in_words(least(needs)).replace(" ", ""))).blocks > 1
