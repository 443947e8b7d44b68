"""The plan: its measurements on scenes with known results, its decisions, and training with it."""

import json
import re
from statistics import fmean

import pytest
import torch
from refusals import refused

from clod_adapter import AdaptConfig, Decision, Override, Scene, make_plan, render
from clod_adapter.adapter import detach
from clod_adapter.initialization.importance import removal_error
from clod_adapter.training.plan import NAMES, NOT_NEEDED
from runs import states_of
from scenes import assert_equal, photograph

CONFIG = AdaptConfig(iters=20, max_sv=4.0, start_share=0.62)
ALL = frozenset(NAMES)


@pytest.fixture(scope="module")
def visible(captured):
    """A capture without unseen Gaussians."""
    base, scene = captured
    return base.select(removal_error(base, [view.camera for view in scene.train]) > 0), scene


def verdicts(plan):
    return {decision.what: decision.verdict for decision in plan.decisions}


def test_sh_degrees_are_kept_or_left_out(visible):
    base, scene = visible
    plan = make_plan(base, scene, CONFIG)
    assert list(verdicts(plan).items())[:2] == [("SH degree 1", "kept"), ("far Gaussians", "added")]
    assert plan.sh_degree == 1
    faint = base.replace(shN=1e-5 * base.shN)
    plan = make_plan(faint, scene, CONFIG)
    assert verdicts(plan)["SH degree 1"] == "left out" and plan.sh_degree == 0
    assert plan.start.sh_degree == 0
    assert torch.equal(detach(plan.adapt(scene).gaussians).shN, faint.shN)
    black = base.replace(shN=torch.zeros(len(base), 15, 3))
    empty = make_plan(black, scene, CONFIG, Override(keep=ALL - {"bands"}))
    assert empty.decisions[0].what == "SH degree 1 to 3"
    assert empty.decisions[0].number == 0
    assert empty.sh_degree == 0
    # A view that gains makes up for none that loses.
    strong = base.replace(shN=20 * base.shN)
    cameras = [view.camera for view in scene.train[:4]]
    mixed = (*photograph(strong, cameras[:2]), *photograph(strong.without_bands(0), cameras[2:]))
    assert make_plan(strong, Scene(mixed, ()), CONFIG).sh_degree == 1
    plan = make_plan(base.without_bands(0), scene, CONFIG, Override(keep=ALL))
    assert plan.decisions[0] == Decision("SH degrees", NOT_NEEDED, "there are none")


def test_the_far_end_is_told(visible):
    """The share that the start keeps at max_sv, and the max_sv at which few are kept."""
    plan = make_plan(*visible, CONFIG)
    (told,) = (f"{one.what} {one.why}" for one in plan.decisions if "at s = 4" in one.what)
    numbers = re.search(r"(\d+)% at .*?(\d+)% with --max-sv (\d+)", told).groups()
    kept, few, farther = map(int, numbers)
    start = plan.start

    def percent(s):
        counts = [int(render(start, view.camera, s).kept.sum()) for view in visible[1].train]
        return 100 * fmean(counts) / start.whole

    assert percent(4.0) == pytest.approx(kept, abs=0.51)
    assert percent(farther + 1) <= few < percent(farther / 1.2)


def test_impossible_overrides_are_refused():
    with refused(r"'colour' is not part of a plan; the names are bands, means"):
        Override(keep=frozenset({"colour"}))
    with refused("'quats' is both kept and left out"):
        Override(frozenset({"quats", "bands"}), frozenset({"quats"}))


def test_a_resumed_plan_gives_the_same_bits(visible):
    """A plan that is made again is the same, and resumes to the same bits; what is frozen is
    unchanged.
    """
    base, scene = visible
    frozen = Override(leave_out=frozenset({"means", "scales"}))
    plan = make_plan(base, scene, CONFIG, frozen)
    again = make_plan(base, scene, CONFIG, frozen)
    states = {}
    assert plan.decisions == again.decisions and json.loads(json.dumps(plan.as_dict()))["decisions"]
    whole = plan.adapt(scene, states_of({12}, states)).gaussians
    resumed = again.adapt(scene, resume=states[12]).gaussians
    assert_equal(resumed, whole)
    assert_equal(detach(resumed), base)
    assert torch.equal(resumed.means, plan.start.means)
    assert not torch.equal(resumed.quats, plan.start.quats)
