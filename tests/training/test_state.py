"""States of training and their files: resumed runs end with the same bits, and other states are refused."""

import copy

import pytest
import torch

from clod_adapter import AdaptConfig, AttenuationConfig, Gaussians, Phase, Progress, Scene, TrainableSubset, adapt
from clod_adapter.adapter import ATTRIBUTES, with_dial
from clod_adapter.training.state import TrainingState
from runs import config_of, states_of
from scenes import assert_equal

Pair = tuple[Gaussians, Scene]


RATES = ("means", "quats", "scales", "opacities", "sh0", "shN")
RESUMED = {
    "ours": {}, "paper": vars(AdaptConfig.paper(iters=12, max_sv=4.0)),
    "sigma_d alone": {"growth": "off", **{f"lr_{name}": 0.0 for name in RATES}},
}  # fmt: skip


@pytest.mark.parametrize("form", RESUMED)
def test_a_resumed_run_ends_with_the_same_bits(captured: Pair, form: str) -> None:
    """From states within and at the end of a round of views, and before, during and after averaging."""
    base, scene = captured
    if form == "sigma_d alone":
        base = base.replace(shN=torch.zeros_like(base.shN))
    if form == "paper":
        base = with_dial(base, torch.full((len(base),), 1.5), AttenuationConfig(scene_distance=4.0, max_sv=3.0))
    config, states = config_of(**{"iters": 12, **RESUMED[form]}), dict[int, TrainingState]()
    whole = adapt(base, scene, config, states_of({1, 6, 10, 11}, states))
    if form == "sigma_d alone":
        assert all(torch.equal(getattr(whole.gaussians, name), getattr(base, name)) for name in ATTRIBUTES)
    seen: list[Progress] = []
    for steps, state in states.items():
        again = adapt(base, scene, config, seen.append, copy.deepcopy(state))
        assert_equal(again.gaussians, whole.gaussians)
        assert (again.steps, again.interrupted, again.start_seconds) == (12, False, whole.start_seconds), steps
        assert again.seconds > state.seconds
    assert {p.phase for p in seen} == {Phase.TRAINING} and [p.done for p in seen[:11]] == list(range(2, 13))


@pytest.mark.parametrize("distance", [1.0, 4.0])
def test_untrained_rows_keep_their_units_when_resumed(captured: Pair, distance: float) -> None:
    """Their dial is not in the state, but the base's, sigma_d in its unit, growth 0 where it has none."""
    base, scene = captured
    settings = AttenuationConfig(scene_distance=distance, reference_distance=4.0)
    growth_d = torch.linspace(-0.5, 1, len(base)) if distance == 1 else None
    base = with_dial(base, torch.linspace(0.3, 3, len(base)) * 4 / distance, settings, growth_d)
    part, states = TrainableSubset(len(base) // 2), dict[int, TrainingState]()
    whole = adapt(base, scene, config_of(iters=4), states_of({2}, states), subset=part)
    again = adapt(base, scene, config_of(iters=4), None, states[2], subset=part)
    assert_equal(again.gaussians, whole.gaussians)
    rest = slice(len(base) // 2, None)
    torch.testing.assert_close(whole.gaussians.sigma_d[rest], base.sigma_d[rest] * distance)
