"""Decisions of a plan, with both results."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from clod_adapter.adapter import with_dial
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Phase, Stopped
from clod_adapter.render import render
from clod_adapter.training import planner
from clod_adapter.training.loop import adapt
from clod_adapter.training.plan import NAMES, NOT_NEEDED, RATES, Decision, Override, Plan
from clod_adapter.training.planner import make_plan
from scenes import assert_equal, with_unseen

CONFIG = AdaptConfig(iters=40, max_sv=4.0, start_share=0.62)
ALL = frozenset(NAMES)


def verdicts(plan: Plan) -> dict[str, str]:
    return {decision.what: decision.verdict for decision in plan.decisions}


def test_plan_is_reproducible(visible: tuple[Gaussians, Scene]) -> None:
    base, scene = with_unseen(visible[0])[0], visible[1]
    plans = [make_plan(base, scene, CONFIG) for _ in range(2)]
    assert plans[0].decisions == plans[1].decisions
    assert_equal(plans[0].start, plans[1].start)
    assert json.loads(json.dumps(plans[0].as_dict()))["decisions"][1]["number"] >= 40


def test_sh_degrees_are_kept_or_left_out(visible: tuple[Gaussians, Scene]) -> None:
    base, scene = visible
    plan = make_plan(base.replace(shN=1e-5 * base.shN), scene, CONFIG)
    assert verdicts(plan)["SH degree 1"] == "left out" and plan.sh_degree == 0
    plan = make_plan(base, scene, CONFIG)
    assert verdicts(plan) == {"SH degree 1": "kept", "unseen Gaussians": "kept"} and plan.sh_degree == 1


def test_share_at_full_quality_is_measured(visible: tuple[Gaussians, Scene]) -> None:
    base, scene = visible
    plan = make_plan(base, scene, replace(CONFIG, start_share=None))
    (decision,) = (one for one in plan.decisions if "at s = 1" in one.what)
    share = plan.config.start_share
    assert share is not None and decision.what == f"{share:.0%} of the Gaussians at s = 1" and decision.number < 0.03
    first = render(plan.start, scene.train[0].camera, 1.0).kept.float().mean()
    assert abs(float(first) - share) < 0.15
    for fixed in (CONFIG, replace(CONFIG, start_share=None, max_sv=1.0)):
        unmeasured = make_plan(base, scene, fixed)
        assert unmeasured.config.start_share == fixed.start_share
        assert not any("at s = 1" in one.what for one in unmeasured.decisions)


def test_empty_sh_degrees_are_one_line(visible: tuple[Gaussians, Scene]) -> None:
    base, scene = visible
    empty = base.replace(shN=torch.zeros(len(base), 15, 3))
    plan = make_plan(empty, scene, CONFIG, Override(keep=ALL - {"bands"}))
    assert plan.decisions[0].what == "SH degree 1 to 3" and plan.decisions[0].number == 0 and plan.sh_degree == 0
    assert not any("SH" in decision.what for decision in plan.decisions[1:])


@pytest.mark.parametrize("override", [Override(), Override(keep=ALL), Override(leave_out=frozenset({"bands"}))])
def test_absent_sh_degrees_cannot_be_overridden(visible: tuple[Gaussians, Scene], override: Override) -> None:
    base, scene = visible
    plan = make_plan(base.without_bands(0), scene, CONFIG, override)
    assert plan.decisions[0] == Decision("SH degrees", NOT_NEEDED, None, "", "there are none")


@pytest.mark.parametrize("name", NAMES)
def test_each_decision_can_be_overridden(
    visible: tuple[Gaussians, Scene], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plan lists an attribute only if it is frozen."""
    base, scene = with_unseen(visible[0])[0], visible[1]
    monkeypatch.setattr(planner, "sh_degree_losses", lambda *_: pytest.fail("measured a fixed decision"))
    kept = make_plan(base, scene, CONFIG, Override(keep=ALL))
    assert (kept.kept, kept.sh_degree, kept.config) == (None, 1, CONFIG)
    assert verdicts(kept) == {"SH degrees": "kept", "unseen Gaussians": "kept"}
    gone = make_plan(base, scene, CONFIG, Override(ALL - {name}, frozenset({name})))
    expected = {"bands": (0, False), "unseen": (1, True)}.get(name, (1, False))
    assert (gone.sh_degree, gone.kept is not None) == expected
    assert gone.config == (replace(CONFIG, **{RATES[name]: 0.0}) if name in RATES else CONFIG)
    (verdict,) = {decision.verdict for decision in gone.decisions if decision.name == name}
    assert verdict == ("frozen" if name in RATES else "left out")
    assert {d.name for d in gone.decisions} == {"bands", "unseen", name}
    assert all(decision.why.startswith("as requested") for decision in gone.decisions if decision.name != "unseen")


def test_unseen_gaussians_of_a_base_with_a_dial_are_kept(visible: tuple[Gaussians, Scene]) -> None:
    """Other dial values may show them."""
    base, scene = with_unseen(visible[0])[0], visible[1]
    adapted = adapt(base, scene, replace(CONFIG, iters=5)).gaussians
    assert make_plan(adapted, scene, CONFIG, Override(keep=ALL - {"unseen"})).kept is None
    assert make_plan(with_dial(base), scene, CONFIG, Override(keep=ALL - {"unseen"})).kept is not None
    assert make_plan(adapted, scene, CONFIG, Override(ALL - {"unseen"}, frozenset({"unseen"}))).kept is not None


@pytest.mark.parametrize("start", ["constant", "identity"])
def test_unseen_gaussians_that_are_not_culled_first_are_kept(visible: tuple[Gaussians, Scene], start: str) -> None:
    """At s > 1 what occludes them may be culled before them."""
    base, before = with_unseen(visible[0])
    config = replace(CONFIG, start=start)
    plan = make_plan(base, visible[1], config, Override(keep=ALL - {"unseen"}))
    assert plan.kept is None and plan.decisions[1].name == "unseen" and "not measured" in plan.decisions[1].why
    asked = make_plan(base, visible[1], config, Override(ALL - {"unseen"}, frozenset({"unseen"})))
    assert asked.kept is not None and not asked.kept[~before].any()


def test_an_invisible_checkpoint_is_kept(visible: tuple[Gaussians, Scene]) -> None:
    base, scene = visible
    faint = base.replace(opacity_logits=torch.full_like(base.opacity_logits, -9.0))
    plan = make_plan(faint, scene, CONFIG)
    assert plan.kept is None and verdicts(plan)["unseen Gaussians"] == "kept"


def test_preparation_steps_that_were_skipped_are_listed(visible: tuple[Gaussians, Scene]) -> None:
    base, scene = visible
    read = replace(scene, left_out=(("undistortion", "the cameras are pinholes"),))
    plan = make_plan(base, read, CONFIG, Override(keep=ALL))
    assert plan.decisions[-1] == Decision("undistortion", NOT_NEEDED, None, "", "the cameras are pinholes")


@pytest.mark.parametrize("phase", [Phase.SH_DEGREES, Phase.IMPORTANCE, Phase.PRUNING_ORDER])
def test_a_listener_stops_the_plan(visible: tuple[Gaussians, Scene], phase: Phase) -> None:
    with pytest.raises(Stopped):
        make_plan(*visible, CONFIG, progress=lambda now: now.phase != phase)
    with pytest.raises(Stopped):  # at the last step of the phase
        make_plan(*visible, CONFIG, progress=lambda now: now.phase != phase or now.done < now.total)
