"""ViewSampler: each view once a round, by the seed alone, and again from a state."""

from __future__ import annotations

import pytest

from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.view_sampler import ViewSampler
from scenes import capture

VIEWS = capture(n=20)[1].train


def nine(draws: ViewSampler) -> list[tuple[str, list[float]]]:
    return [(view.camera.name, dials) for view, dials in (draws.draw() for _ in range(9))]


def test_each_view_once_a_round() -> None:
    draws = ViewSampler(VIEWS, AdaptConfig())
    for _ in range(3):
        seen = [draws.draw()[0].camera.name for _ in VIEWS]
        assert sorted(seen) == sorted(view.camera.name for view in VIEWS)


@pytest.mark.parametrize("sampling", ["pair", "log", "uniform"])
def test_the_seed_and_a_state_decide_all(sampling: str) -> None:
    config = AdaptConfig(sampling=sampling, full_share=0.3, seed=3)
    one, two, other = (
        ViewSampler(VIEWS, config),
        ViewSampler(VIEWS, config),
        ViewSampler(VIEWS, AdaptConfig(sampling=sampling, seed=4)),
    )
    first = nine(one)
    assert nine(two) == first != nine(other)
    state, rest = one.state(), nine(one)
    one.restore(*state)
    assert nine(one) == rest and two.state() == state
    assert all(1 <= s <= config.max_sv for _, dials in first for s in dials)


def test_states_that_cannot_be_are_refused() -> None:
    draws = ViewSampler(VIEWS, AdaptConfig())
    random, order = draws.state()
    with pytest.raises(ClodError, match="of other Gaussians, views or settings"):
        draws.restore(random, (*order, len(VIEWS)))
    with pytest.raises(ClodError, match="random state is damaged"):
        draws.restore({"bit_generator": "MT19937"}, order)
