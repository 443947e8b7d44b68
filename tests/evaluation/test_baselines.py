"""The dial value of a count, and rankings of the base."""

import pytest
import torch

from clod_adapter.adapter import with_dial
from clod_adapter.config import AttenuationConfig
from clod_adapter.evaluation.baselines import matching_dial, mean_kept, rankings
from clod_adapter.initialization.importance import removal_error
from clod_adapter.render import render
from scenes import capture, gaussians, ring


def test_matching_dial_keeps_as_many() -> None:
    n = 2000
    some, cameras = gaussians(n, 0, 0), ring(3, 32, 24)
    some = with_dial(some, torch.linspace(0.3, 8, n), AttenuationConfig(tau=1 / 255, scene_distance=4.0, max_sv=200))
    at_one = mean_kept(some, cameras, 1.0)
    assert at_one == sum(int(render(some, camera).kept.sum()) for camera in cameras) / 3
    for count in (0.9 * at_one, 400, 100.5, 30):
        s = matching_dial(some, cameras, count)
        assert s > 1 and mean_kept(some, cameras, s) == pytest.approx(count, rel=1e-3, abs=0.4)
    assert mean_kept(some, cameras, matching_dial(some, cameras, 0)) <= 1
    assert matching_dial(some, cameras, at_one) == matching_dial(some, cameras, n) == 1
    assert matching_dial(gaussians(20, 0, 0), cameras[:1], 10) == 1  # no dial


def test_rankings_put_the_most_important_first() -> None:
    base, scene = capture(n=60, views=4, width=24, height=18)
    orders = rankings(base, scene.train)
    assert list(orders) == ["opacity", "removal error"] and not torch.equal(*orders.values())
    for order, values in zip(orders.values(), (base.opacity_logits, removal_error(base, scene.train)), strict=True):
        assert torch.equal(order.sort().values, torch.arange(60)) and (values[order].diff() <= 0).all()
