"""Without photographs the reach of far Gaussians follows the pictures."""

import pytest
import torch

from clod_adapter import make_plan
from clod_adapter.progress import Phase
from clod_adapter.training import camera_placement
from clod_adapter.training.far_reach import fit_far_reach
from clod_adapter.training.pseudo_views import with_pseudo_views
from runs import config_of
from scenes import assert_equal, capture


@pytest.fixture(scope="module")
def started():
    """Gaussians before training, and the pseudo views to train on."""
    base, _ = capture()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera_placement, "WIDTH", 124)
        patch.setattr(camera_placement, "HEIGHT", 92)
        views = with_pseudo_views(base, None, 0)
    return make_plan(base, views, config_of()).start, views.train


def of_colour(gaussians, change):
    """The far Gaussians' colours changed."""
    sh0 = torch.where(gaussians.near[:, None, None], gaussians.sh0, change(gaussians.sh0))
    return gaussians.replace(sh0=sh0)


def test_bad_far_ones_are_put_off(started):
    """Where far Gaussians are worse, they reach less far; nothing else changes."""
    start, views = started
    wrong = of_colour(start, lambda sh0: -sh0)
    good, bad = (fit_far_reach(each, views) for each in (start, wrong))
    far = ~start.near
    assert bool((bad.sigma_d[far] < good.sigma_d[far]).all())
    assert_equal(bad.replace(sigma_d=start.sigma_d, attenuation=start.attenuation), wrong)


def test_a_listener_ends_the_search_with_what_is_best_so_far(started):
    start, views = started
    seen = []

    def stop(now):
        seen.append(now.phase)
        return len(seen) < 2

    assert_equal(fit_far_reach(start, views, stop), start)
    assert seen == [Phase.FAR_REACH] * 2


def test_photographs_decide_nothing_of_it():
    base, scene = capture()
    plan = make_plan(base, scene, config_of(iters=2))
    phases = set()
    adapted = plan.adapt(scene, lambda now: phases.add(now.phase))
    assert Phase.FAR_REACH not in phases
    start = plan.start.attenuation
    assert adapted.gaussians.attenuation.reference_distance == start.reference_distance
