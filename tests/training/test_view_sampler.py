"""ViewSampler draws each view once a round, reproducibly from a seed or a state."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from clod_adapter.cameras import StoredView, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.view_sampler import RENDERED, ViewSampler
from scenes import capture

VIEWS = capture(n=20)[1].train


def nine(draws: ViewSampler) -> list[tuple[str, float]]:
    return [(view.camera.name, s) for view, s, *_ in (draws.draw(k, k / 9) for k in range(9))]


@pytest.mark.parametrize("sampling", ["log", "uniform"])
def test_draws_are_reproducible_from_a_seed_or_state(sampling: str) -> None:
    config = AdaptConfig(sampling=sampling, full_share=0.3, seed=3)
    one, two, other = (ViewSampler(VIEWS, each) for each in (config, config, replace(config, seed=4)))
    first = nine(one)
    assert nine(two) == first != nine(other)
    state, rest = one.state(), nine(one)
    one.restore(*state)
    assert nine(one) == rest and two.state() == state
    assert all(s == 0 or 1 <= s <= RENDERED * config.max_sv for _, s in first)
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
    """In [0, 1], and more evenly than random numbers would be."""
    values = values.sort().values.double()
    assert (values - torch.linspace(0, 1, len(values))).abs().max() < 3 / len(values)


@pytest.mark.parametrize("seed", [0, 5])
def test_dial_values_follow_the_configured_distribution(seed: int) -> None:
    """1, or 0, in ``full_share`` of the steps (falling), else (log-)uniform from 1 on; in every stretch."""
    end = RENDERED * 4.0

    def drawn(share_done: float = 0.0, **changes: Any) -> torch.Tensor:
        sampler = ViewSampler(VIEWS, AdaptConfig(max_sv=4.0, seed=seed, **changes))
        return torch.tensor([sampler.draw(k, share_done).dial for k in range(480)], dtype=torch.float64)

    for stretch in drawn(full_share=0.25).split(120):
        assert abs(int((stretch <= 1).sum()) - 30) <= 1 and abs(int((stretch == 0).sum()) - 7.5) <= 1
        assert_uniform(stretch[stretch > 1].log() / math.log(end))
    assert_uniform((drawn(sampling="uniform", full_share=0.0) - 1) / (end - 1))
    assert (drawn(full_share=1.0) <= 1).all()
    late = drawn(0.5, full_share=0.5, full_final=0.5)
    assert abs(int((late <= 1).sum()) - 0.375 * 480) <= 1
    assert ViewSampler(VIEWS, AdaptConfig(max_sv=1.0, full_share=0.0)).draw(0, 0.0)[1:] == (1.0, None, False)
    assert drawn(full_share=0.0, tau=0.2).max() < (4 + 1 / 0.2) / 2  # at 5 nothing is kept


def test_first_steps_have_photographs_of_half_the_size() -> None:
    """Unless these would be small, or the step is at s = 1."""
    camera = replace(VIEWS[0].camera, width=301, height=258, K=torch.tensor([[90.0, 0, 150], [0, 90, 129], [0, 0, 1]]))
    image = torch.randint(256, (258, 301, 3), generator=torch.Generator().manual_seed(0)).byte()
    large, small = View(camera, image), View(replace(camera, height=255), image[:255])

    cases = ((large, 0.49, 0.0, True), (large, 0.5, 0.0, False), (small, 0.0, 0.0, False), (large, 0.0, 1.0, False))
    for view, share_done, full, expected in cases:
        sample = ViewSampler((view,), AdaptConfig(coarse=0.5, full_share=full)).draw(0, share_done)
        assert sample.halved == expected and (sample.view is view) != expected


def test_photographs_are_read_after_the_draw() -> None:
    """By the process whose share of the batch they are; a failure to read does not advance the sampler."""

    def image() -> torch.Tensor:
        raise OSError("not here")

    camera = replace(VIEWS[0].camera, width=300, height=258)
    sample = ViewSampler((StoredView(camera, image),), AdaptConfig(coarse=0.5)).draw(0, 0.0)
    with pytest.raises(OSError, match="not here"):
        _ = sample.view.image
