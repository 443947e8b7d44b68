"""The initial growth: areas of the Gaussians that were removed, and its range."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.equation.extinction import sigma_for_extinction
from clod_adapter.equation.growth import growth_factors
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import initialize
from clod_adapter.initialization.pruning_order import MOST, SHARE, initial_growth, pruning_order
from scenes import gaussians, photograph, ring

MAX_SV = 5.0


def equal_ones(opacities: list[float], until: list[float]) -> tuple[Gaussians, Tensor]:
    """Gaussians that differ in opacity and in the dial value at which each is culled, and their distances."""
    count, config = len(opacities), AttenuationConfig(tau=1e-4, max_sv=MAX_SV)
    some, d = gaussians(1, 0, 0).select(torch.zeros(count, dtype=torch.int64)), torch.full((count,), 0.9)
    some = some.replace(opacity_logits=torch.tensor(opacities).logit())
    sigma_d = sigma_for_extinction(some.opacity_logits, d, torch.tensor(until), config)
    return some.replace(sigma_d=sigma_d, attenuation=config), d


@pytest.mark.parametrize(
    ("opacities", "until", "substitutes", "larger"),
    [([0.25, 0.5], [2.0, 9.0], [1, 1], 1.5), ([0.5, 0.5], [9.0, 9.0], [1, 1], 1.0),
     ([0.1] * 4 + [0.5], [2.0, 2.5, 3.0, 3.5, 9.0], [1, 2, 3, 4, 4], 1.8)],
    ids=["half as opaque", "both are kept", "chain"],
)  # fmt: skip
def test_growth_preserves_the_area(
    monkeypatch: pytest.MonkeyPatch, opacities: list[float], until: list[float], substitutes: list[int], larger: float
) -> None:
    """Fitted at the end of the dial alone, the remaining one has the area of all that it stands for."""
    monkeypatch.setattr("clod_adapter.initialization.pruning_order.DIALS", 2)
    some, d = equal_ones(opacities, until)
    fitted = initial_growth(some, torch.tensor(substitutes), d) / SHARE
    factor = growth_factors(fitted, d, MAX_SV, 1.0)[-1]
    assert factor.square() == pytest.approx(larger, rel=1e-4) and not fitted[:-1].any()


def test_exponents_are_in_range_and_0_without_descendants() -> None:
    some, d = gaussians(400, 0, 0), torch.full((400,), 0.9)
    order = pruning_order(some, torch.rand(400, generator=torch.Generator().manual_seed(0)))
    until = 1 + 9 * (order.position + 1) / 400
    config = AttenuationConfig(tau=1e-6, max_sv=MAX_SV)
    sigma_d = sigma_for_extinction(some.opacity_logits, d, until, config)
    found = initial_growth(some.replace(sigma_d=sigma_d, attenuation=config), order.substitute, d)
    assert found.dtype == torch.float32 and found.min() >= 0 and found.max() <= MOST * SHARE
    stands_for_others = torch.zeros(400, dtype=torch.bool)
    stands_for_others[order.substitute[order.substitute != torch.arange(400)]] = True
    assert not found[~stands_for_others].any() and (found[stands_for_others] > 0).sum() > 50
    for iters in (0, 1):  # growth begins with 0 where it is trained
        grown = initialize(some, photograph(some, ring(2, 16, 12)), AdaptConfig(iters=iters)).growth_d
        assert bool(grown.any()) == (iters == 0)
