"""The pruning order against a plain implementation, and its effect."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.initialization.pruning_order import (
    APART,
    COLOUR_FLOOR,
    NEIGHBOURS,
    REMOVED,
    pruning_order,
)
from scenes import gaussians


def plainly(some: Gaussians, worth: Tensor) -> list[int]:
    """The order computed round by round and pair by pair."""
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


@pytest.mark.parametrize(("n", "seed"), [(0, 0), (1, 0), (2, 0), (9, 2), (60, 1)])
def test_order_matches_the_plain_implementation(n: int, seed: int) -> None:
    some, seen = gaussians(n, 1, seed), []
    worth = torch.rand(n, generator=torch.Generator().manual_seed(seed))
    order = pruning_order(some, worth, lambda now: seen.append((now.done, now.total))).position
    assert order.argsort().tolist() == plainly(some, worth), f"n {n}, seed {seed}"
    assert n < 60 or (seen == sorted(seen) and 0 < seen[0][0] < 30 and seen[-1] == (60, 60))


def test_coincident_gaussians_are_moved_apart() -> None:
    """A k-d tree cannot separate coincident points and would compare all pairs."""
    some, seen = gaussians(2000, 0, 0), []
    alike = some.replace(means=torch.zeros(2000, 3), sh0=torch.zeros(2000, 1, 3))
    # Of no worth and no size at all: ties, and nothing to divide by.
    for one in (alike, alike.replace(log_scales=torch.full((2000, 3), -400.0))):
        seen.clear()
        order = pruning_order(one, torch.zeros(2000), lambda now: seen.append((now.done, now.total))).position
        assert order.sort().values.equal(torch.arange(2000)) and len(seen) < 300
