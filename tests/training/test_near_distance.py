"""Without photographs the distance at which far Gaussians take over follows the pictures."""

import pytest
import torch

from clod_adapter import make_plan
from clod_adapter.progress import Phase
from clod_adapter.training.near_distance import fit_near_distance
from clod_adapter.training.pseudo_views import with_pseudo_views
from runs import config_of
from scenes import assert_equal, capture


@pytest.fixture(scope="module")
def started():
    """Gaussians before training, and the pseudo views to train on."""
    base, _ = capture()
    views = with_pseudo_views(base, None, 0)
    return make_plan(base, views, config_of()).start, views.train


def of_colour(gaussians, change):
    """The far Gaussians' colours changed."""
    sh0 = torch.where(gaussians.near[:, None, None], gaussians.sh0, change(gaussians.sh0))
    return gaussians.replace(sh0=sh0)


def test_bad_far_ones_are_put_off(started):
    """Where far Gaussians are worse, near ones are drawn to a larger distance; nothing else
    changes.
    """
    start, views = started
    wrong = of_colour(start, lambda sh0: -sh0)
    good, bad = (fit_near_distance(each, views) for each in (start, wrong))
    assert bad.attenuation.near_distance > good.attenuation.near_distance
    assert_equal(bad.replace(attenuation=start.attenuation), wrong)


def test_a_listener_ends_the_search_with_what_is_best_so_far(started):
    start, views = started
    seen = []

    def stop(now):
        seen.append(now.phase)
        return len(seen) < 2

    assert_equal(fit_near_distance(start, views, stop), start)
    assert seen == [Phase.NEAR_DISTANCE] * 2


def test_photographs_decide_nothing_of_it():
    base, scene = capture()
    plan = make_plan(base, scene, config_of(iters=2))
    phases = set()
    adapted = plan.adapt(scene, lambda now: phases.add(now.phase))
    assert Phase.NEAR_DISTANCE not in phases
    trained = adapted.gaussians.attenuation.near_distance
    assert trained == plan.start.attenuation.near_distance
