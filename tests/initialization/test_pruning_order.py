"""The leaving order against a plain twin, and what it is for."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.initialization.pruning_order import (
    APART,
    COLOUR_FLOOR,
    NEIGHBOURS,
    REMOVED,
    _without_crowds,
    pruning_order,
)
from scenes import gaussians


def plainly(some: Gaussians, worth: Tensor) -> list[int]:
    """Round by round, pair by pair."""
    worths, left, order = worth.double().tolist(), list(range(len(some))), []
    centres, colours = some.means.double(), 0.5 + SH_C0 * some.sh0[:, 0].double()
    sizes = some.log_scales.double().exp().amax(1)

    def unlike(i: int, j: int) -> float:
        apart, reach = (centres[i] - centres[j]).square().sum(), (sizes[i] + sizes[j]).square()
        return float((colours[i] - colours[j]).square().sum() + COLOUR_FLOOR**2 + APART * apart / (apart + reach))

    while len(left) > 1:
        heirs = {}
        for i in left:
            near = sorted((j for j in left if j != i), key=lambda j: float((centres[i] - centres[j]).square().sum()))
            heirs[i] = min(near[:NEIGHBOURS], key=lambda j: unlike(i, j))
        ranked = sorted(left, key=lambda i: worths[i] * unlike(i, heirs[i]))
        leaving = [i for i in ranked[: max(int(REMOVED * len(left)), 1)] if ranked.index(heirs[i]) > ranked.index(i)]
        leaving = [i for i in leaving if i not in [heirs[j] for j in leaving]]
        for i in leaving:
            worths[heirs[i]] += worths[i]
        order += leaving
        left = [i for i in left if i not in leaving]
    return order + left


@pytest.mark.parametrize("n", [2, 3, 9, 10, 60])
@pytest.mark.parametrize("seed", range(3))
def test_is_that_of_the_plain_twin(n: int, seed: int) -> None:
    some = gaussians(n, 1, seed)
    worth = torch.rand(n, generator=torch.Generator().manual_seed(seed))
    assert pruning_order(some, worth).argsort().tolist() == plainly(some, worth), f"n {n}, seed {seed}"


@pytest.mark.parametrize("n", [0, 1])
def test_of_none_and_of_one(n: int) -> None:
    assert pruning_order(gaussians(n, 0, 0), torch.ones(n)).tolist() == list(range(n))


def test_one_of_two_alike_is_removed_before_a_single_less_important_one() -> None:
    """And by worth alone both would stay: that is what the order is for."""
    three = gaussians(3, 0, 0)
    means = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [5.0, 0, 0]])
    three = three.replace(
        means=means, sh0=three.sh0[:1].expand(3, 1, 3).contiguous(), log_scales=torch.full((3, 3), -2.0)
    )
    order = pruning_order(three, torch.tensor([1.0, 1.1, 0.9]))
    assert order.tolist() == [0, 2, 1]


def test_does_not_depend_on_the_order_of_the_rows() -> None:
    some, worth = gaussians(80, 1, 4), torch.rand(80, generator=torch.Generator().manual_seed(4))
    rows = torch.randperm(80, generator=torch.Generator().manual_seed(5))
    assert torch.equal(pruning_order(some.select(rows), worth[rows]), pruning_order(some, worth)[rows])


def test_all_in_one_place_and_of_no_worth() -> None:
    """Ties, and nothing to divide by: a permutation nevertheless."""
    some = gaussians(50, 0, 0)
    some = some.replace(means=torch.zeros(50, 3), log_scales=torch.full((50, 3), -400.0))
    assert sorted(pruning_order(some, torch.zeros(50)).tolist()) == list(range(50))


def test_reports_its_progress() -> None:
    seen: list[tuple[int, int]] = []
    pruning_order(gaussians(100, 0, 0), torch.ones(100), lambda now: seen.append((now.done, now.total)))
    assert seen == sorted(seen) and 0 < seen[0][0] < 50 and seen[-1] == (100, 100)


def test_many_in_one_place_take_few_rounds() -> None:
    some, seen = gaussians(2000, 0, 0), []
    some = some.replace(means=torch.zeros(2000, 3), sh0=torch.zeros(2000, 1, 3))
    order = pruning_order(some, torch.zeros(2000), lambda now: seen.append((now.done, now.total)))
    assert sorted(order.tolist()) == list(range(2000)) and len(seen) < 300


def test_many_in_one_place_are_moved_apart() -> None:
    """A k-d tree cannot part them, and would compare each with all: hours for some hundred thousand."""
    sizes = np.full(200, 0.1)
    sizes[3] = math.inf
    crowd = _without_crowds(np.full((200, 3), 0.3), sizes)
    assert len(np.unique(np.delete(crowd, 3, 0), axis=0)) == 199 and np.abs(crowd - 0.3).max() <= 1e-7
    spread = np.random.default_rng(0).normal(size=(200, 3))
    assert _without_crowds(spread, sizes) is spread
    some = gaussians(300, 0, 0)
    order = pruning_order(some.replace(means=torch.full_like(some.means, 0.3)), torch.rand(300))
    assert order.sort().values.equal(torch.arange(300))


def test_what_is_not_finite() -> None:
    """Colours and sizes are then unlike all others; centres are refused."""
    some = gaussians(20, 0, 0)
    odd = some.replace(sh0=some.sh0.index_fill(0, torch.tensor([3, 4]), math.inf))
    odd = odd.replace(log_scales=some.log_scales.index_fill(0, torch.tensor([5]), math.nan))
    assert sorted(pruning_order(odd, torch.rand(20)).tolist()) == list(range(20))
    with pytest.raises(ClodError, match="means are not all finite"):
        pruning_order(some.replace(means=some.means.index_fill(0, torch.tensor([3]), math.nan)), torch.rand(20))
