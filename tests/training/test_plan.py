"""Training with a plan equals training without one, except for the parts left out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from clod_adapter.adapter import ATTRIBUTES, DIAL
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import initialize
from clod_adapter.progress import Progress
from clod_adapter.render import render
from clod_adapter.training.loop import adapt
from clod_adapter.training.plan import NAMES, Override
from clod_adapter.training.planner import make_plan
from scenes import assert_equal, with_unseen

CONFIG = AdaptConfig(iters=40, max_sv=4.0, start_share=0.62)
ALL = frozenset(NAMES)


def test_training_is_the_same_if_nothing_is_left_out(visible: tuple[Gaussians, Scene]) -> None:
    base, scene = visible
    plan = make_plan(base, scene, CONFIG)
    assert plan.kept is None and plan.config == CONFIG and not plan.trims(base)
    planned = plan.adapt(scene).gaussians
    assert_equal(plan.whole(base, planned), adapt(plan.start, scene, CONFIG).gaussians)
    assert_equal(plan.adapt(scene).gaussians, planned)  # a plan can be used again


def test_a_resumed_plan_gives_the_same_bits(visible: tuple[Gaussians, Scene]) -> None:
    """A plan that is made again resumes to the same bits, with unseen Gaussians and frozen attributes."""
    base, scene = with_unseen(visible[0])[0], visible[1]
    states: list[Any] = []

    def stop(now: Progress) -> bool:
        if now.done == 25 and now.state is not None:
            states.append(now.state())
        return now.done < 25

    plans = [make_plan(base, scene, CONFIG, Override(leave_out=frozenset({"means", "scales"}))) for _ in range(2)]
    plans[0].adapt(scene, stop)
    assert "parameter.quats" in states[0].tensors and "parameter.means" not in states[0].tensors
    steps: list[int] = []
    found = plans[1].whole(base, plans[1].adapt(scene, lambda now: steps.append(now.done), states[0]).gaussians)
    assert steps == list(range(26, 41))
    assert_equal(found, plans[0].whole(base, plans[0].adapt(scene).gaussians))
    assert torch.equal(found.means, base.means) and torch.equal(found.log_scales, base.log_scales)
    assert not torch.equal(found.quats, base.quats)


def test_unseen_gaussians_are_unchanged(visible: tuple[Gaussians, Scene]) -> None:
    base, before = with_unseen(visible[0])
    scene = visible[1]
    plan = make_plan(base, scene, CONFIG)
    assert plan.kept is not None and not plan.kept[~before].any()
    lean = plan.adapt(scene).gaussians
    assert len(lean) == int(plan.kept.sum())
    whole, initial = plan.whole(base, lean), plan.start
    for name in ATTRIBUTES:
        assert torch.equal(getattr(whole, name)[~plan.kept], getattr(base, name)[~plan.kept]), name
        assert torch.equal(getattr(whole, name)[plan.kept], getattr(lean, name)), name
    for name in DIAL:
        assert torch.equal(getattr(whole, name)[~plan.kept], getattr(initial, name)[~plan.kept]), name
        assert torch.equal(getattr(whole, name)[plan.kept], getattr(lean, name)), name
    assert not torch.equal(lean.means, base.means[plan.kept])  # seen ones are trained


def test_growth_of_the_base_is_dropped_without_growth(visible: tuple[Gaussians, Scene]) -> None:
    """Also of Gaussians that are left out, and if it is trained from an earlier result."""
    base, scene = with_unseen(visible[0])[0], visible[1]
    plan = make_plan(base.replace(shN=0 * base.shN), scene, replace(CONFIG, iters=2, growth="off"))
    assert plan.kept is not None and plan.sh_degree == 0
    assert plan.whole(base, plan.adapt(scene).gaussians).growth_d is None
    grown = initialize(base, scene.train, CONFIG)
    plan = make_plan(grown, scene, replace(CONFIG, iters=2, growth="off"), Override(leave_out=frozenset({"bands"})))
    assert plan.trims(grown) and plan.whole(grown, plan.adapt(scene).gaussians).growth_d is None


def test_target_counts_are_shares_of_all_gaussians(visible: tuple[Gaussians, Scene]) -> None:
    """With a third of the file unseen, a dial value keeps as many Gaussians as if all were trained."""
    base, scene = with_unseen(visible[0], 150)[0], visible[1]
    config = replace(CONFIG, iters=80)
    plan = make_plan(base, scene, config, Override(keep=ALL - {"unseen"}))
    left_out = plan.whole(base, plan.adapt(scene).gaussians)
    trained = adapt(base, scene, config).gaussians
    for s in (2.0, 4.0):
        kept = [render(g, scene.test[0].camera, s).kept.sum().item() for g in (left_out, trained)]
        assert kept[0] == pytest.approx(kept[1], rel=0.15)


def test_tuned_sh_degrees_return_to_their_place(visible: tuple[Gaussians, Scene]) -> None:
    base, scene = visible
    base = base.replace(shN=torch.cat([base.shN, 1e-6 * torch.ones(len(base), 5, 3)], 1))
    plan = make_plan(base, scene, replace(CONFIG, lr_shN=1e-2))
    assert plan.sh_degree == 1
    whole = plan.whole(base, plan.adapt(scene).gaussians)
    assert torch.equal(whole.shN[:, 3:], base.shN[:, 3:]) and not torch.equal(whole.shN[:, :3], base.shN[:, :3])


def test_sh_degrees_that_are_left_out_are_unchanged(visible: tuple[Gaussians, Scene]) -> None:
    base, scene = visible
    faint = base.replace(shN=1e-5 * base.shN)
    plan = make_plan(faint, scene, CONFIG)
    lean = plan.adapt(scene).gaussians
    assert lean.sh_degree == 0 and torch.equal(plan.whole(faint, lean).shN, faint.shN)
    assert plan.trims(faint) and plan.trimming_effect(faint, scene).number == pytest.approx(0, abs=0.02)


def test_bad_overrides() -> None:
    with pytest.raises(ClodError, match=r"'colour' is not part of a plan; the names are bands, unseen, means"):
        Override(keep=frozenset({"colour"}))
    with pytest.raises(ClodError, match="'quats' is both kept and left out"):
        Override(frozenset({"quats", "bands"}), frozenset({"quats"}))
