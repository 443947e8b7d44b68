"""The pruning order against a plain implementation, its effect, and the growth that follows from it."""

import pytest
import torch
from torch import Tensor

from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.equation.extinction import sigma_for_extinction
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.initialization.importance import initialize
from clod_adapter.initialization.pruning_order import (
    APART,
    COLOUR_FLOOR,
    MOST,
    NEIGHBOURS,
    REMOVED,
    SHARE,
    initial_growth,
    pruning_order,
)
from scenes import gaussians, photograph, ring


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


@pytest.mark.parametrize(("n", "seed"), [(0, 0), (1, 0), (2, 0), (60, 1)])
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


MAX_SV = 5.0


def test_exponents_are_in_range_and_0_without_descendants() -> None:
    some, d = gaussians(400, 0, 0), torch.full((400,), 0.9)
    order = pruning_order(some, torch.rand(400, generator=torch.Generator().manual_seed(0)))
    config = AttenuationConfig(tau=1e-6, max_sv=MAX_SV)
    sigma_d = sigma_for_extinction(some.opacity_logits, d, 1 + 9 * (order.position + 1) / 400, config)
    found = initial_growth(some.replace(sigma_d=sigma_d, attenuation=config), order.substitute, d)
    alone = torch.ones(400, dtype=torch.bool)
    alone[order.substitute[order.substitute != torch.arange(400)]] = False
    assert found.dtype == torch.float32 and found.min() >= 0 and found.max() <= MOST * SHARE
    assert not found[alone].any() and (found[~alone] > 0).sum() > 50
    for iters in (0, 1):  # growth begins with 0 where it is trained
        grown = initialize(some, photograph(some, ring(2, 16, 12)), AdaptConfig(iters=iters)).growth_d
        assert bool(grown.any()) == (iters == 0)
