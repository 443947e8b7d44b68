"""The plan: its measurements on scenes with known results, its decisions, and training with it."""

import json
import math
import re
from dataclasses import replace
from statistics import fmean

import pytest
import torch

from clod_adapter import AdaptConfig, ClodError, Decision, Gaussians, Override, Plan, Scene, make_plan, render
from clod_adapter.adapter import ATTRIBUTES, DIAL, detach, with_dial
from clod_adapter.initialization.importance import initialize, removal_error
from clod_adapter.training.dial import TrainableSubset
from clod_adapter.training.plan import NAMES, NOT_NEEDED, largest_change
from clod_adapter.training.planner import seen
from clod_adapter.training.state import TrainingState
from runs import states_of
from scenes import assert_equal, gaussians, photograph, ring, with_unseen

Pair = tuple[Gaussians, Scene]
CONFIG = AdaptConfig(iters=20, max_sv=4.0, start_share=0.62)
ALL, LIMIT = frozenset(NAMES), 0.02


@pytest.fixture(scope="module")
def visible(captured: Pair) -> Pair:
    """A capture without unseen Gaussians."""
    base, scene = captured
    return base.select(removal_error(base, scene.train) > 0), scene


def verdicts(plan: Plan) -> dict[str, str]:
    return {decision.what: decision.verdict for decision in plan.decisions}


def test_seen_gaussians_change_a_pixel_when_removed() -> None:
    """Whichever views the error is from: a shell, Gaussians inside, outside every image, too faint, and around it."""
    base = gaussians(70, 1, 2, size=0.1)
    means, logs, logits = base.means, base.log_scales, base.opacity_logits
    around = 2 * math.pi * torch.arange(24) / 24
    means[:24] = torch.stack([around.sin(), torch.zeros(24), around.cos()], 1)
    logs[:24], logits[:24] = math.log(0.8), 9.0
    means[24:32], logs[24:32] = 0.05 * means[24:32], math.log(0.02)
    means[32:40] += torch.tensor([0.0, 80.0, 0.0])
    logits[40:46] = -8.0
    views, matters = photograph(base, ring(6, 40, 30)), torch.zeros(70, dtype=torch.bool)
    for camera in (view.camera for view in views):
        image = render(base, camera).image
        for row in range(70):
            matters[row] |= not torch.equal(image, render(base.select(torch.arange(70) != row), camera).image)
    for first in (6, 2):
        error = removal_error(base, views[:first])
        found = seen(base, views[first:], error, 0)
        assert found.tolist() == matters.tolist() and not found[24:46].any() and found[:24].all()
    change, lost = largest_change(base, base.select(found), views)
    assert change < 1e-6 and abs(lost) < 1e-6  # all of them at once, too
    # One opaque all over: its alpha is clamped in every pixel and has no derivative, and the image is all its own.
    base.means[0], base.log_scales[0], base.opacity_logits[0] = 0.0, math.log(100.0), math.inf
    views = photograph(base, ring(3, 40, 30))
    error = removal_error(base, views)
    assert error[0] == 0 and seen(base, views, error, seed=0)[0]


def test_sh_degrees_are_kept_or_left_out(visible: Pair) -> None:
    base, scene = visible
    plan = make_plan(base, scene, CONFIG)
    assert list(verdicts(plan).items())[:2] == [("SH degree 1", "kept"), ("unseen Gaussians", "kept")]
    assert plan.sh_degree == 1 and plan.kept is None
    faint = base.replace(shN=1e-5 * base.shN)
    plan = make_plan(faint, scene, CONFIG)
    assert verdicts(plan)["SH degree 1"] == "left out" and plan.sh_degree == 0
    lean = plan.adapt(scene).gaussians
    assert lean.sh_degree == 0 and torch.equal(detach(plan.whole(faint, lean)).shN, faint.shN)
    assert plan.trims(faint) and plan.trimming_effect(faint, scene).number == pytest.approx(0, abs=0.02)
    empty = make_plan(base.replace(shN=torch.zeros(len(base), 15, 3)), scene, CONFIG, Override(keep=ALL - {"bands"}))
    assert empty.decisions[0].what == "SH degree 1 to 3" and empty.decisions[0].number == 0 and empty.sh_degree == 0
    # A view that gains makes up for none that loses.
    strong, cameras = base.replace(shN=20 * base.shN), [view.camera for view in scene.train[:4]]
    mixed = (*photograph(strong, cameras[:2]), *photograph(strong.without_bands(0), cameras[2:]))
    assert make_plan(strong, Scene(mixed, ()), CONFIG).sh_degree == 1
    plan = make_plan(base.without_bands(0), scene, CONFIG, Override(keep=ALL))
    assert plan.decisions[0] == Decision("SH degrees", NOT_NEEDED, None, "", "there are none")


def test_share_at_full_quality_is_measured(visible: Pair) -> None:
    base, scene = visible
    plan = make_plan(base, scene, replace(CONFIG, start_share=None), far=False)
    (decision,) = (one for one in plan.decisions if "at s = 1" in one.what)
    share = plan.config.start_share
    assert share is not None and decision.what == f"{share:.0%} of the Gaussians at s = 1" and decision.number < 0.03


def test_the_far_end_is_told(visible: Pair) -> None:
    """The share that the start keeps at max_sv, and the max_sv at which few are kept."""
    plan = make_plan(*visible, CONFIG)
    (told,) = (f"{one.what} {one.why}" for one in plan.decisions if "at s = 4" in one.what)
    kept, few, farther = map(int, re.search(r"(\d+)% at .*?(\d+)% with --max-sv (\d+)", told).groups())
    start = plan.start

    def percent(s: float) -> float:
        return 100 * fmean(int(render(start, view.camera, s).kept.sum()) / start.whole for view in visible[1].train)

    assert percent(4.0) == pytest.approx(kept, abs=0.51) and percent(farther + 1) <= few < percent(farther / 1.2)


def test_impossible_overrides_are_refused() -> None:
    with pytest.raises(ClodError, match=r"'colour' is not part of a plan; the names are bands, unseen, means"):
        Override(keep=frozenset({"colour"}))
    with pytest.raises(ClodError, match="'quats' is both kept and left out"):
        Override(frozenset({"quats", "bands"}), frozenset({"quats"}))


def test_unseen_gaussians_are_kept_where_another_dial_value_may_show_them(visible: Pair) -> None:
    """Of a base with a dial, in the paper's form, and of a checkpoint that is invisible altogether."""
    base, scene = with_unseen(visible[0])[0], visible[1]
    asked, forced = Override(keep=ALL - {"unseen"}), Override(ALL - {"unseen"}, frozenset({"unseen"}))
    paper, adapted = AdaptConfig.paper(iters=40, max_sv=4.0), initialize(base, scene.train, CONFIG)
    for some, config in ((adapted, CONFIG), (base, paper)):
        plan = make_plan(some, scene, config, asked)
        assert plan.kept is None and plan.decisions[1].name == "unseen" and "not measured" in plan.decisions[1].why
        assert make_plan(some, scene, config, forced).kept is not None
    assert make_plan(with_dial(base), scene, CONFIG, asked, far=False).kept is not None
    assert make_plan(base, scene, CONFIG, asked).kept is None  # near Gaussians stay
    faint = base.replace(opacity_logits=torch.full_like(base.opacity_logits, -9.0))
    assert make_plan(faint, scene, CONFIG).kept is None


def test_a_resumed_plan_gives_the_same_bits(visible: Pair) -> None:
    """A plan that is made again is the same, and resumes to the same bits: what is left out or frozen is unchanged."""
    (base, before), scene = with_unseen(visible[0]), visible[1]
    plan, again = (
        make_plan(base, scene, CONFIG, Override(leave_out=frozenset({"means", "scales"})), far=False) for _ in "ab"
    )
    kept, states = plan.kept, dict[int, TrainingState]()
    assert plan.decisions == again.decisions and kept is not None and not kept[~before].any()
    assert plan.subset == TrainableSubset(len(plan.lean), total=len(base))
    assert json.loads(json.dumps(plan.as_dict()))["decisions"][1]["number"] >= 40
    whole = plan.whole(base, plan.adapt(scene, states_of({12}, states)).gaussians)
    lean = again.adapt(scene, resume=states[12]).gaussians
    found = again.whole(base, lean)
    assert_equal(found, whole)
    for name in (*ATTRIBUTES, *DIAL):
        others = plan.start if name in DIAL else base
        assert torch.equal(getattr(found, name)[~kept], getattr(others, name)[~kept]), name
        assert torch.equal(getattr(found, name)[kept], getattr(lean, name)), name
    assert torch.equal(found.means, base.means) and not torch.equal(found.quats, base.quats)
