"""ViewSampler draws each view once a round, reproducibly from a seed or a state."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.view_sampler import ViewSampler
from scenes import capture

VIEWS = capture(n=20)[1].train


def nine(draws: ViewSampler) -> list[tuple[str, list[float]]]:
    return [(view.camera.name, dials) for view, dials, _ in (draws.draw(k / 9) for k in range(9))]


@pytest.mark.parametrize("sampling", ["pair", "log", "uniform"])
def test_draws_are_reproducible_from_a_seed_or_state(sampling: str) -> None:
    config = AdaptConfig(sampling=sampling, full_share=0.3, seed=3)
    one, two, other = (ViewSampler(VIEWS, each) for each in (config, config, replace(config, seed=4)))
    first = nine(one)
    assert nine(two) == first != nine(other)
    state, rest = one.state(), nine(one)
    one.restore(*state)
    assert nine(one) == rest and two.state() == state
    assert all(1 <= s <= config.max_sv for _, dials in first for s in dials)
    names = [name for name, _ in [*first, *rest]]  # each view once a round
    for start in range(0, len(names) - len(VIEWS) + 1, len(VIEWS)):
        assert sorted(names[start : start + len(VIEWS)]) == sorted(view.camera.name for view in VIEWS)


def test_impossible_states_are_refused() -> None:
    draws = ViewSampler(VIEWS, AdaptConfig())
    random, order = draws.state()
    with pytest.raises(ClodError, match="of other Gaussians, views or settings"):
        draws.restore(random, (*order, len(VIEWS)))
    with pytest.raises(ClodError, match="random state is damaged"):
        draws.restore({"bit_generator": "MT19937"}, order)


def assert_uniform(values: torch.Tensor) -> None:
    values = values.sort().values.double()
    assert (values - torch.linspace(0, 1, len(values))).abs().max() < 1.7 / len(values) ** 0.5  # Kolmogorov-Smirnov


def test_dial_values_follow_the_configured_distribution() -> None:
    """Pair: 1 and a log-uniform value in [1, max_sv]; in the first half of training half of the pairs are two values,
    half the dial apart. Others: 1 with ``full_share``, or log-uniform, or uniform."""

    def drawn(share_done: float = 0.9, **changes: Any) -> torch.Tensor:
        sampler = ViewSampler(VIEWS, AdaptConfig(max_sv=4.0, **changes))
        return torch.tensor([sampler.draw(share_done)[1] for _ in range(480)])

    pairs = drawn(sampling="pair")
    assert (pairs[:, 0] == 1).all() and pairs.shape == (480, 2)
    assert_uniform(pairs[:, 1].log() / math.log(4))
    early = drawn(0.4, sampling="pair").log() / math.log(4)
    apart = early[early[:, 0] > 0]
    assert 0.4 < len(apart) / len(early) < 0.6
    torch.testing.assert_close(apart[:, 1] - apart[:, 0], torch.full_like(apart[:, 0], 0.5))
    assert_uniform(apart.flatten())
    assert_uniform(early[early[:, 0] == 0, 1])
    assert ViewSampler(VIEWS, AdaptConfig(max_sv=1.0)).draw(0.0)[1:] == ([1.0], None)
    ones = drawn(sampling="log", full_share=0.25).log() / math.log(4)
    assert 0.19 < (ones == 0).double().mean() < 0.31  # 3 standard deviations
    assert_uniform(ones[ones > 0])
    assert_uniform((drawn(sampling="uniform", full_share=0.0)[:, 0] - 1) / 3)
