"""The gate: training that harms s = 1 is undone."""

import pytest
import torch

from clod_adapter import Gaussians, Scene, render
from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.initialization.importance import initialize
from clod_adapter.training.gate import decibels_below, split_views, squared_error
from clod_adapter.training.loop import TrainingState, adapt
from runs import config_of, states_of
from scenes import assert_equal, capture, photograph, ring

Pair = tuple[Gaussians, Scene]


@pytest.fixture(scope="module")
def many() -> Pair:
    """Enough views that some are not trained on."""
    return capture(views=16)


def lost(pair: Pair, result: Gaussians, begun: Gaussians) -> float:
    """dB that s = 1 of the result is below that of another, on the held-out views."""
    errors = [[squared_error(render(g, v.camera, 1.0).image, v) for v in pair[1].test] for g in (result, begun)]
    return decibels_below(*errors)


def test_diverging_training_is_undone_and_resumes_to_the_same_bits(many: Pair) -> None:
    config, states = config_of(iters=40).lighter(30.0), dict[int, TrainingState]()
    whole = adapt(*many, config, states_of({20}, states))
    sound = adapt(*many, config_of(iters=40)).watched
    assert whole.watched is not None and whole.watched.rollbacks > 0 == sound.rollbacks
    assert lost(many, whole.gaussians, initialize(many[0], many[1].train, config_of())) < 0.5
    again = adapt(*many, config, progress=False, resume=states[20])
    assert_equal(again.gaussians, whole.gaussians)
    assert again.watched == whole.watched


def test_attributes_are_frozen_in_the_end(many: Pair) -> None:
    base = many[0]
    result = adapt(*many, config_of(iters=40).lighter(1e6))
    assert result.watched is not None and result.watched.frozen
    assert all(torch.equal(getattr(result.gaussians, name), getattr(base, name)) for name in ATTRIBUTES)
    assert not torch.equal(result.gaussians.sigma_d, initialize(base, many[1].train, config_of()).sigma_d)


def test_watched_halves_are_not_trained_on() -> None:
    base, scene = capture()
    views = photograph(base, ring(50, 40, 30))
    trained, watched = split_views(views)
    assert (len(trained), len(watched)) == (50, 2)
    halves = [view for view in trained if view not in views]
    assert [view.camera.name for view in halves] == [view.camera.name for view in watched]
    for left, right in zip(halves, watched, strict=True):
        whole = next(view for view in views if view.camera.name == left.camera.name)
        assert torch.equal(torch.cat([left.image, right.image], 1), whole.image)
        rendered = torch.cat([render(base, half.camera).image for half in (left, right)], 1)
        # Gaussians beyond an image's edge are drawn a little differently (the limit of the projection's Jacobian).
        assert float((rendered - render(base, whole.camera).image).abs().mean()) < 0.01
    assert split_views(scene.train) == (scene.train, scene.train)  # too few
