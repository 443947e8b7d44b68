"""The plan: each decision both ways, and a training that is the same but for what was left out."""

from __future__ import annotations

import json
import weakref
from dataclasses import replace
from typing import Any

import pytest
import torch

from clod_adapter.adapter import ATTRIBUTES, attach
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import initialize, removal_error
from clod_adapter.progress import Phase, Progress, Stopped
from clod_adapter.render import render
from clod_adapter.training import planner
from clod_adapter.training.loop import adapt
from clod_adapter.training.objective import Objective
from clod_adapter.training.plan import NAMES, RATES, Decision, Override, Plan
from clod_adapter.training.planner import make_plan
from scenes import capture, photograph

CONFIG = AdaptConfig(iters=40, max_sv=4.0)
ALL = frozenset(NAMES)


@pytest.fixture(scope="module")
def captured() -> tuple[Gaussians, Scene]:
    """Where all is seen."""
    base, scene = capture()
    return base.select(removal_error(base, scene.train) > 0), scene


@pytest.fixture(autouse=True)
def short_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner, "PROBE", 6)
    monkeypatch.setattr(planner, "SHARE", 0.3)


def with_unseen(base: Gaussians, count: int = 40) -> tuple[Gaussians, torch.Tensor]:
    """The same with Gaussians out of every picture mixed in, and which rows were there before."""
    far = base.select(torch.arange(count)).replace(means=base.means[:count] + torch.tensor([0.0, 90.0, 0.0]))
    order = torch.randperm(len(base) + count, generator=torch.Generator().manual_seed(4))
    values = {name: torch.cat([value, far.tensors()[name]])[order] for name, value in base.tensors().items()}
    return base.replace(**values), order < len(base)


def verdicts(plan: Plan) -> dict[str, str]:
    return {decision.what: decision.verdict for decision in plan.decisions}


def assert_equal(a: Gaussians, b: Gaussians) -> None:
    assert a.tensors().keys() == b.tensors().keys() and a.attenuation == b.attenuation
    for name, value in a.tensors().items():
        assert torch.equal(value, b.tensors()[name]), name


def test_where_all_is_needed_training_is_what_it_was(captured: tuple[Gaussians, Scene]) -> None:
    """The first steps, after which the attributes were judged, are not done twice, and not otherwise."""
    base, scene = captured
    plan = make_plan(base, scene, CONFIG)
    assert set(verdicts(plan).values()) == {"kept", "trained"} and plan.kept is None
    assert plan.begun.steps == 6 and plan.config == CONFIG
    steps: list[int] = []
    begun, states, freed = weakref.ref(plan.begun), [plan.begun], replace(plan, begun=None)
    again = plan.adapt(scene)
    del plan

    def follow(now: Progress) -> None:
        steps.append(now.done)
        assert begun() is None  # its tensors are not held twice while training runs

    planned = freed.adapt(scene, follow, states.pop())
    assert steps == list(range(7, 41)) and planned.steps == 40
    assert_equal(freed.whole(base, planned.gaussians), adapt(base, scene, CONFIG).gaussians)
    assert_equal(again.gaussians, planned.gaussians)  # a plan can be used again


def test_the_same_plan_again(captured: tuple[Gaussians, Scene]) -> None:
    base, scene = with_unseen(captured[0])[0], captured[1]
    plans = [make_plan(base, scene, CONFIG) for _ in range(2)]
    assert plans[0].decisions == plans[1].decisions
    assert_equal(plans[0].start, plans[1].start)
    assert json.loads(json.dumps(plans[0].as_dict()))["decisions"][1]["number"] >= 40


def test_unseen_gaussians_come_back_as_they_were(captured: tuple[Gaussians, Scene]) -> None:
    base, before = with_unseen(captured[0])
    scene = captured[1]
    plan = make_plan(base, scene, CONFIG)
    assert plan.kept is not None and not plan.kept[~before].any()
    lean = plan.adapt(scene).gaussians
    assert len(lean) == int(plan.kept.sum())
    whole, begun = plan.whole(base, lean), initialize(base, scene.train, CONFIG)
    for name in ATTRIBUTES:
        assert torch.equal(getattr(whole, name)[~plan.kept], getattr(base, name)[~plan.kept]), name
        assert torch.equal(getattr(whole, name)[plan.kept], getattr(lean, name)), name
    assert whole.sigma_d is not None and begun.sigma_d is not None and lean.sigma_d is not None
    assert torch.equal(whole.sigma_d[~plan.kept], begun.sigma_d[~plan.kept])
    assert torch.equal(whole.sigma_d[plan.kept], lean.sigma_d)
    assert not torch.equal(lean.means, base.means[plan.kept])  # and those that are seen were trained


def test_the_counts_stay_shares_of_all(captured: tuple[Gaussians, Scene]) -> None:
    """With a third of the file unseen the dial keeps as many as it would with it trained along."""
    base, scene = with_unseen(captured[0], 150)[0], captured[1]
    config = replace(CONFIG, iters=80)
    plan = make_plan(base, scene, config, Override(keep=ALL - {"unseen"}))
    left_out = plan.whole(base, plan.adapt(scene).gaussians)
    trained = adapt(base, scene, config).gaussians
    for s in (2.0, 4.0):
        kept = [render(g, scene.test[0].camera, s).kept.sum().item() for g in (left_out, trained)]
        assert kept[0] == pytest.approx(kept[1], rel=0.15)


def test_bands_both_ways(captured: tuple[Gaussians, Scene]) -> None:
    base, scene = captured
    faint = base.replace(shN=1e-5 * base.shN)
    plan = make_plan(faint, scene, CONFIG)
    assert verdicts(plan)["SH degree 1"] == "left out" and plan.sh_degree == 0
    lean = plan.adapt(scene).gaussians
    assert lean.sh_degree == 0 and torch.equal(plan.whole(faint, lean).shN, faint.shN)
    assert plan.trims(faint) and plan.trimming_effect(faint, scene).number == pytest.approx(0, abs=0.02)
    plan = make_plan(base, scene, CONFIG)
    assert verdicts(plan)["SH degree 1"] == "kept" and plan.sh_degree == 1 and not plan.trims(base)


def test_empty_bands_are_one_line(captured: tuple[Gaussians, Scene]) -> None:
    base, scene = captured
    empty = base.replace(shN=torch.zeros(len(base), 15, 3))
    plan = make_plan(empty, scene, CONFIG, Override(keep=ALL - {"bands"}))
    assert plan.decisions[0].what == "SH degree 1 to 3" and plan.decisions[0].number == 0 and plan.sh_degree == 0
    assert not any("SH" in decision.what for decision in plan.decisions[1:])


@pytest.mark.parametrize("override", [Override(), Override(keep=ALL), Override(leave_out=frozenset({"bands"}))])
def test_no_bands_are_neither_kept_nor_left_out_as_asked(captured: tuple[Gaussians, Scene], override: Override) -> None:
    base, scene = captured
    plan = make_plan(base.without_bands(0), scene, CONFIG, override)
    assert plan.decisions[0] == Decision("SH degrees", "left out", None, "", "there are none")


def test_tuned_bands_come_back_in_their_place(captured: tuple[Gaussians, Scene]) -> None:
    base, scene = captured
    base = base.replace(shN=torch.cat([base.shN, 1e-6 * torch.ones(len(base), 5, 3)], 1))
    plan = make_plan(base, scene, replace(CONFIG, lr_shN=1e-2))
    assert plan.sh_degree == 1
    whole = plan.whole(base, plan.adapt(scene).gaussians)
    assert torch.equal(whole.shN[:, 3:], base.shN[:, 3:]) and not torch.equal(whole.shN[:, :3], base.shN[:, :3])


def test_what_cannot_matter_is_frozen(captured: tuple[Gaussians, Scene]) -> None:
    """Rotations of round Gaussians, whose pictures do not know them; of others they are trained."""
    base, scene = captured
    round_ones = base.replace(log_scales=base.log_scales.mean(1, keepdim=True).expand(-1, 3).contiguous())
    seen = tuple(photograph(round_ones, [view.camera for view in scene.train]))
    settings = replace(CONFIG, lr_scales=0.0)  # which would not stay round
    plan = make_plan(round_ones, replace(scene, train=seen), settings)
    assert verdicts(plan)["quats"] == "frozen" and plan.config.lr_quats == 0 and not plan.begun
    assert plan.frozen == ("quats", "scales") and "scales" not in verdicts(plan)
    assert torch.equal(plan.adapt(replace(scene, train=seen)).gaussians.quats, base.quats)
    assert verdicts(make_plan(base, scene, settings))["quats"] == "trained"


def test_short_trainings_are_not_judged(captured: tuple[Gaussians, Scene], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner, "effect", lambda *_: pytest.fail("judged"))
    plan = make_plan(*captured, replace(CONFIG, iters=19))
    assert {d.verdict for d in plan.decisions if d.name in RATES} == {"trained"} and not plan.begun


def test_a_short_time_budget_is_not_spent_on_judging(captured: tuple[Gaussians, Scene]) -> None:
    """What was done of it is gone on from."""
    base, scene = captured
    plan = make_plan(base, scene, replace(CONFIG, time_budget=1e-4))
    assert plan.begun.steps == 1 and not plan.frozen
    assert plan.adapt(scene).steps == 1


@pytest.mark.parametrize("name", NAMES)
def test_each_decision_can_be_overridden(
    captured: tuple[Gaussians, Scene], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    base, scene = with_unseen(captured[0])[0], captured[1]
    for measure in ("sh_degree_losses", "effect"):
        monkeypatch.setattr(planner, measure, lambda *_: pytest.fail("measured a fixed decision"))
    kept = make_plan(base, scene, CONFIG, Override(keep=ALL))
    assert kept.kept is None and kept.sh_degree == 1 and kept.frozen == () and not kept.begun
    gone = make_plan(base, scene, CONFIG, Override(ALL - {name}, frozenset({name})))
    expected = {"bands": ((), 0, False), "unseen": ((), 1, True)}.get(name, ((name,), 1, False))
    assert (gone.frozen, gone.sh_degree, gone.kept is not None) == expected
    (verdict,) = {decision.verdict for decision in gone.decisions if decision.name == name}
    assert verdict == ("frozen" if name in RATES else "left out")
    assert all(decision.why.startswith("as requested") for decision in gone.decisions if decision.name != "unseen")


def test_misuse() -> None:
    with pytest.raises(ClodError, match=r"'colour' is not part of a plan; the names are bands, unseen, means"):
        Override(keep=frozenset({"colour"}))
    with pytest.raises(ClodError, match="'quats' is both kept and left out"):
        Override(frozenset({"quats", "bands"}), frozenset({"quats"}))
    base, scene = capture(20)
    with pytest.raises(ClodError, match="no training views"):
        make_plan(base, Scene((), scene.test))
    with pytest.raises(ClodError, match="no Gaussians"):
        make_plan(base.select(torch.arange(0)), scene)


def test_a_base_with_a_dial_is_not_searched(captured: tuple[Gaussians, Scene]) -> None:
    """What its dial leaves out shows others."""
    base, scene = with_unseen(captured[0])[0], captured[1]
    adapted = adapt(base, scene, replace(CONFIG, iters=5)).gaussians
    assert make_plan(adapted, scene, CONFIG, Override(keep=ALL - {"unseen"})).kept is None
    assert make_plan(attach(base), scene, CONFIG, Override(keep=ALL - {"unseen"})).kept is not None
    assert make_plan(adapted, scene, CONFIG, Override(ALL - {"unseen"}, frozenset({"unseen"}))).kept is not None


@pytest.mark.parametrize("begin", ["constant", "identity"])
def test_a_start_with_which_none_leave_leaves_none_out(captured: tuple[Gaussians, Scene], begin: str) -> None:
    """At s > 1 they would show as they were, what hid them having left."""
    base, before = with_unseen(captured[0])
    config = replace(CONFIG, start=begin)
    plan = make_plan(base, captured[1], config, Override(keep=ALL - {"unseen"}))
    assert plan.kept is None and plan.decisions[1].name == "unseen" and "not measured" in plan.decisions[1].why
    asked = make_plan(base, captured[1], config, Override(ALL - {"unseen"}, frozenset({"unseen"})))
    assert asked.kept is not None and not asked.kept[~before].any()


def test_a_checkpoint_that_shows_nothing(captured: tuple[Gaussians, Scene]) -> None:
    base, scene = captured
    faint = base.replace(opacity_logits=torch.full_like(base.opacity_logits, -9.0))
    plan = make_plan(faint, scene, CONFIG)
    assert plan.kept is None and verdicts(plan)["unseen Gaussians"] == "kept"


def test_what_reading_left_out_is_told(captured: tuple[Gaussians, Scene]) -> None:
    base, scene = captured
    read = replace(scene, left_out=(("undistortion", "the cameras are pinholes"),))
    plan = make_plan(base, read, CONFIG, Override(keep=ALL))
    assert plan.decisions[-1] == Decision("undistortion", "left out", None, "", "the cameras are pinholes")


@pytest.mark.parametrize("phase", [Phase.SH_DEGREES, Phase.IMPORTANCE, Phase.PRUNING_ORDER, Phase.FIRST_STEPS])
def test_a_listener_ends_the_plan(captured: tuple[Gaussians, Scene], phase: Phase) -> None:
    with pytest.raises(Stopped):
        make_plan(*captured, CONFIG, progress=lambda now: now.phase != phase)
    with pytest.raises(Stopped):  # at the last step of the phase
        make_plan(*captured, CONFIG, progress=lambda now: now.phase != phase or now.done < now.total)


def test_a_probe_that_fails_leaves_the_failure_to_the_training(
    captured: tuple[Gaussians, Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which then ends with what the steps before have learned."""
    pull, steps = Objective.gradient_sum, []

    def failing(self: Objective, *given: Any) -> Any:
        steps.append(1)
        found = pull(self, *given)
        return found if len(steps) < 4 else replace(found, loss=float("nan"))

    monkeypatch.setattr(Objective, "gradient_sum", failing)
    plan = make_plan(*captured, CONFIG)
    found = plan.adapt(captured[1])
    assert found.steps == 3 and "loss of step 4 is not finite" in (found.failed or "") and plan.frozen == ()


def test_going_on_with_what_was_frozen(captured: tuple[Gaussians, Scene], monkeypatch: pytest.MonkeyPatch) -> None:
    base, scene = with_unseen(captured[0])[0], captured[1]
    config = replace(CONFIG, lr_scales=0.0)
    first = make_plan(base, scene, config, Override(leave_out=frozenset({"means"})))
    states: list[Any] = []

    def stop(now: Progress) -> bool:
        if now.done == 25 and now.state is not None:
            states.append(now.state())
        return now.done < 25

    first.adapt(scene, stop)
    monkeypatch.setattr(planner, "effect", lambda *_: pytest.fail("judged again"))
    again = make_plan(base, scene, config, resumed=first.frozen)
    assert again.frozen == first.frozen == ("means", "scales")
    result = again.adapt(scene, resume=states[0])
    assert_equal(again.whole(base, result.gaussians), first.whole(base, first.adapt(scene).gaussians))
