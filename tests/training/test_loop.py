"""Adapting a small generated scene: quality, dial and errors."""

import copy
import math
import sys
from dataclasses import replace
from types import ModuleType

import pytest
import torch
import torch.distributed as dist
from refusals import refused
from torch.testing import assert_close
from torch.torch_version import TorchVersion

from clod_adapter import Phase, Scene, Stopped, evaluate, make_plan
from clod_adapter.adapter import ATTRIBUTES, detach, with_dial
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.equation.distances import in_frustum
from clod_adapter.equation.units import with_distance
from clod_adapter.initialization.importance import scene_distance
from clod_adapter.training.distributed import joined
from clod_adapter.training.far import with_far
from clod_adapter.training.loop import adapt
from runs import change_step, config_of, states_of
from scenes import assert_equal, capture, gaussians, photograph, ring


@pytest.fixture(scope="module")
def trained(captured):
    return adapt(*captured, config_of(iters=120)).gaussians


def test_training_improves_psnr(captured, trained):
    """At every dial value; growth at the far end, and no count depends on it."""
    base, scene = captured
    before = adapt(base, scene, config_of(iters=0)).gaussians
    dials = (1.5, 2.0, 3.0, 5.0)
    for views in (scene.train, scene.test):
        rows = zip(evaluate(before, views, dials), evaluate(trained, views, dials), strict=True)
        assert all(new.psnr > old.psnr + 0.5 for old, new in rows)
    plain = adapt(base, scene, config_of(iters=120, growth="off")).gaussians
    near, far = evaluate(trained, scene.test, (1.0, 5.0))
    plain_near, plain_far = evaluate(plain, scene.test, (1.0, 5.0))
    assert far.psnr > plain_far.psnr + 0.1 and near.psnr > plain_near.psnr - 0.3
    assert near.kept_share == pytest.approx(plain_near.kept_share, abs=0.03)
    assert far.kept_share == pytest.approx(plain_far.kept_share, abs=0.03)


def test_zero_steps_return_the_initialization(captured):
    base, scene = captured
    result = adapt(base, scene, config_of(iters=0))
    start = result.gaussians
    want = with_far(base, scene.train, config_of())
    assert result.steps == 0 and not result.interrupted
    for name in ATTRIBUTES:
        assert torch.equal(getattr(start, name), getattr(want, name))
    assert_equal(detach(start), base)
    # by way of its logarithm
    assert_close(start.sigma_d, want.sigma_d, rtol=1e-5, atol=0)
    assert start.attenuation == want.attenuation and want.attenuation.scene_distance == 1
    assert want.attenuation.reference_distance == pytest.approx(scene_distance(base, scene.train))
    # At SIGMA_MAX no gradient reaches sigma_d, so a dial of with_dial is initialized, too.
    assert_equal(adapt(with_dial(base), scene, config_of(iters=0)).gaussians, start)


def test_a_second_run_continues_from_sigma_d(captured, trained):
    """No importance pass; the unit is the file's reference distance, or the views' where another
    tool dropped it.
    """
    _, scene = captured
    phases = []
    config = config_of(iters=1, max_sv=3.0)
    attenuation = trained.attenuation
    unknown = trained.replace(attenuation=replace(attenuation, reference_distance=0.0))
    for given, want in (
        (trained, attenuation.reference_distance),
        (unknown, scene_distance(trained, scene.train)),
    ):
        result = adapt(given, scene, config, lambda now: phases.append(now.phase)).gaussians
        distance = result.attenuation.reference_distance
        assert distance == pytest.approx(want) and want > 2 and set(phases) == {Phase.TRAINING}
        assert result.attenuation == replace(attenuation, max_sv=3.0, reference_distance=distance)
        far = trained.sigma_d > 0
        # a step of log sigma
        assert (result.sigma_d / trained.sigma_d)[far].log().abs().max() <= 5.1e-2
        assert (result.growth_d - trained.growth_d).abs().max() <= 1.01e-2
        assert trained.growth_d.unique().numel() > 50
    other = with_dial(captured[0], torch.full((len(captured[0]),), 1.5), AttenuationConfig())
    with refused("dial has no far Gaussians"):
        adapt(other, scene, config)


def test_result_is_the_mean_of_the_last_steps(captured):
    """The mean is over the parameters, so over log sigma_d; the steps do not change."""
    states = {}
    result = adapt(*captured, config_of(iters=10), states_of({9, 10}, states)).gaussians
    result = result.select(~result.near)
    sigma_d = with_distance(result, states[9].attenuation.scene_distance).sigma_d
    for name, values in (*result.tensors().items(), ("log_sigma", sigma_d.log())):
        if name != "sigma_d":
            last, before = (states[step].tensors[f"parameter.{name}"] for step in (10, 9))
            assert_close(values, (last + before) / 2)


def test_time_budget_ends_training(captured):
    """The budget includes the time of an earlier part of the run."""
    config = config_of(iters=10_000_000, time_budget=0.2)
    states = {}
    result = adapt(*captured, config, states_of({3}, states))
    assert 0 < result.steps < 10_000 and 0.2 <= result.seconds < 5 and not result.interrupted
    assert adapt(*captured, config_of(iters=3, time_budget=60.0)).steps == 3
    result = adapt(*captured, config, None, replace(states[3], seconds=0.18))
    assert 3 < result.steps < 10_000 and 0.2 <= result.seconds < 5
    # within the first step
    assert adapt(*captured, config_of(batch=4096, time_budget=0.2)).seconds < 3


def test_a_listener_that_stops_returns_the_result_so_far(captured):
    states = []

    def stop(p):
        if p.phase == Phase.TRAINING:
            states.append(copy.deepcopy(p.gaussians()))
        return p.done != 5 or p.phase != Phase.TRAINING

    result = adapt(*captured, config_of(iters=50), stop)
    for phase in (Phase.IMPORTANCE, Phase.PRUNING_ORDER):
        with pytest.raises(Stopped):
            adapt(*captured, config_of(iters=5), lambda now, phase=phase: now.phase != phase)
    assert result.interrupted and not result.signalled and result.steps == 5
    assert_equal(result.gaussians, states[-1])
    assert not any(value.requires_grad for value in result.gaussians.tensors().values())


def test_degenerate_scenes(captured):
    """One Gaussian, one that is never seen, and coincident cameras."""
    views = photograph(gaussians(20, 0, 0), ring(2, 20, 16))
    for means in ([[0.0, 0.0, 0.0]], [[1e3, 0.0, 0.0]]):
        one = gaussians(1, 0, 0).replace(means=torch.tensor(means))
        found = adapt(one, Scene(views, ()), config_of(iters=5)).gaussians
        assert all(value.isfinite().all() for value in found.tensors().values())
    base, scene = captured
    found = adapt(base, Scene(scene.train[:1] * 2, ()), config_of(iters=3)).gaussians
    assert not found.means.equal(base.means)


def test_bad_inputs_are_refused(captured):
    base, scene = captured
    for run in (adapt, make_plan):
        with refused("no training views"):
            run(base, Scene((), scene.test))
        with refused("no Gaussians"):
            run(gaussians(0, 1, 0), scene)
        for name, value in (("sh0", math.inf), ("opacity_logits", math.nan)):
            values = getattr(base, name).clone()
            values[5:7] = value
            with refused(rf"{name} is not finite in 2 rows \(the first is 5\); leave out"):
                run(base.replace(**{name: values}), scene, config_of(iters=1))
    huge = torch.full_like(base.sh0, 1e38)
    huge[7] = 2e38
    # looked at before training, or by its first step
    for config in (config_of(iters=1), AdaptConfig.paper(iters=1)):
        with refused("not finite.* the largest sh0 is 2e.38, in row 7: leave out such rows"):
            adapt(base.replace(sh0=huge), Scene(scene.train[:1], ()), config)


def test_a_row_with_a_nonfinite_gradient_is_not_stepped(captured, monkeypatch):
    """Only in that step: other rows move, and so does the row in later steps."""

    def spoil(result):
        result.gradients["means"][3, 1] = math.nan
        result.gradients["log_sigma"][4] = -math.inf
        return result

    base, scene = captured
    change_step(monkeypatch, 1, spoil)
    steps = []

    def keep(progress):
        if progress.state:
            steps.append(copy.deepcopy(progress.gaussians()))

    config = config_of(iters=12)
    result = adapt(base, scene, config, keep)
    assert result.held == 2
    assert all(value.isfinite().all() for value in result.gaussians.tensors().values())
    start = with_far(base, scene.train, config)
    models = (start, steps[0], result.gaussians)
    first, after, last = (model.sigma_d[len(base) :] for model in models)
    moved = (after / first - 1).abs() > 1e-5
    assert not moved[3:5].any() and moved.any() and (last[3:5] != first[3:5]).all()


def test_growth_begins_at_the_median_distance_in_the_second_nearest_view(captured):
    base, scene = captured
    nearest, second = sorted(scene_distance(base, [view]) for view in scene.train)[:2]
    assert scene_distance(base, scene.train) == second > nearest
    for view in scene.train:
        if scene_distance(base, [view]) == second:
            distances = (base.means - view.camera.position).norm(dim=1)
            median = distances[in_frustum(base.means, view.camera)].median()
            assert second == pytest.approx(float(median), rel=1e-5)


def test_settings_as_keywords(captured):
    adapted = adapt(*captured, config_of(iters=3), max_sv=7, growth="off")
    text = "Adapted(Gaussians(300 and 240 far, SH degree 1, dial to 7, cpu), 3 steps, "
    assert repr(adapted).startswith(text)
    assert adapted.gaussians.growth_d is None
    with pytest.raises(TypeError, match="max_vs"):
        adapt(*captured, max_vs=7)


def test_a_bar_by_default(captured, monkeypatch, capsys):
    """On a terminal or in a notebook; not elsewhere, not with a listener of one's own, and not with
    False.
    """
    adapt(*captured, iters=1)
    assert capsys.readouterr().err == ""
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    adapt(*captured, iters=1)
    shown = capsys.readouterr().err
    assert all(phase in shown for phase in ("importance", "pruning order", "training: ", "/1 ["))
    for progress in (False, lambda now: None):
        adapt(*captured, iters=1, progress=progress)
    assert capsys.readouterr().err == ""


def test_a_group_of_one_changes_no_bit():
    base, scene = capture(n=60, views=4)
    config = AdaptConfig(iters=3, batch=2)
    want = adapt(base, scene, config)
    with joined(dist.HashStore(), 0, 1) as peers:
        found = adapt(base, scene, config, group=peers)
        assert_equal(found.gaussians, want.gaussians)
        assert found.lost is None
        peers.size = 3
        with refused("batch is 2, it must be at least 3, a view for each of the processes"):
            adapt(base, scene, config, group=peers)


def test_several_processes_need_a_torch_that_does_not_hang(monkeypatch):
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.6.0+cu124"))
    with joined(dist.HashStore(), 0, 1), refused(r"need torch 2.9 or newer, and this is 2.6.0\+"):
        joined(dist.HashStore(), 0, 2).__enter__()
