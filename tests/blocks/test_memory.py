"""Memory plans, and the sizes that --memory accepts."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clod_adapter.blocks.memory import MOST_BLOCKS, MemoryEstimate, least, parse_size, plan_for_limit
from clod_adapter.errors import ClodError

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
