"""Resumed runs end with the same bits, also after a Ctrl-C within ``adapt``."""

import copy
import signal
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from clod_adapter import AdaptConfig, AttenuationConfig, Gaussians, Phase, Progress, Scene, TrainableSubset, adapt
from clod_adapter.adapter import ATTRIBUTES, with_dial
from clod_adapter.training import trainer
from clod_adapter.training.interrupts import GracefulStop
from clod_adapter.training.state import TrainingState
from runs import config_of, pressing, states_of
from scenes import assert_equal, capture

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


CONFIG = AdaptConfig(iters=12, max_sv=3.0)
SCENE = capture(60, views=4, width=16, height=12)


@pytest.fixture(autouse=True)
def default_handler() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_within_the_update_completes_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """The step is completed, and its state resumes to the same bits."""
    whole, states = adapt(*SCENE, CONFIG).gaussians, list[Any]()
    monkeypatch.setattr(trainer, "spoilt_rows", pressing(trainer.spoilt_rows, signal.SIGINT, at=5))
    found = adapt(*SCENE, CONFIG, lambda now: states.append(now.state) if now.state else None)
    assert found.interrupted and found.signalled and found.steps == 5
    assert_equal(adapt(*SCENE, CONFIG, resume=states[-1]()).gaussians, whole)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_other_handlers_are_not_affected() -> None:
    heard, stop = list[int](), GracefulStop()
    signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    with stop.listening(in_place_of=signal.default_int_handler):
        signal.raise_signal(signal.SIGINT)
    assert heard == [signal.SIGINT] and not stop.requests
