"""The gradients of a step: views, dial values, trained rows, screen filter and batch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from clod_adapter.adapter import with_dial
from clod_adapter.cameras import Camera, Scene
from clod_adapter.config import FILTERS
from clod_adapter.equation.growth import GROWTH_RANGE
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import initialize
from clod_adapter.losses import photometric_loss
from clod_adapter.progress import Progress
from clod_adapter.rasterizers import BACKENDS, Rasterizer, cpu, reference
from clod_adapter.render import render
from clod_adapter.training import objective
from clod_adapter.training.gate import Gate
from clod_adapter.training.loop import TrainingState, adapt
from clod_adapter.training.objective import GradientSum, TrainableSubset, loss_weight
from clod_adapter.training.trainer import Trainer
from clod_adapter.training.view_sampler import Sample, ViewSampler
from runs import config_of, states_of
from scenes import assert_equal, gaussians, photograph, ring

Pair = tuple[Gaussians, Scene]


@pytest.mark.parametrize(("rate", "evaluated"), [(0.0, 0), (1e-3, 3)])
def test_screen_filter_is_used_and_empty_harmonics_are_skipped(
    captured: Pair, monkeypatch: pytest.MonkeyPatch, rate: float, evaluated: int
) -> None:
    """Empty harmonics are evaluated if they are trained; the result contains them in either case."""
    mip = FILTERS["mip"]
    base = captured[0].replace(shN=torch.zeros_like(captured[0].shN), screen_filter=mip)
    seen, shown = set(), set()

    class Watched(type(cpu.RASTERIZER)):  # type: ignore[misc]
        def draw(self, g: Gaussians, *given: Any, **more: Any) -> Any:
            seen.add((g.shN.shape[1], g.screen_filter))
            return super().draw(g, *given, **more)

    def watched(*given: Any) -> Any:
        seen.add((given[5].shape[1], given[8]))
        return cpu.rasterize(*given)

    monkeypatch.setitem(BACKENDS, "cpu", lambda: Watched(watched))

    def look(now: Progress) -> None:
        if now.gaussians:
            shown.add(now.gaussians().screen_filter)

    found = adapt(base, captured[1], config_of(iters=4, lr_shN=rate), look).gaussians
    assert seen == {(evaluated, mip)} and shown == {found.screen_filter} == {mip}
    assert found.shN.shape == base.shN.shape and found.shN.any() == (rate > 0)


def test_one_step_moves_kept_rows_by_their_rates(captured: Pair) -> None:
    """At s = 1 on one view, the loss is the render's, and culled rows do not move."""
    base, scene = captured
    alone = Scene(scene.train[:2], ())
    config = config_of(iters=1, full_share=1.0, reg_weight=0.0, seed=1)
    assert ViewSampler(alone.train, config).draw(0, 0.0).dial == 1
    before, seen = initialize(base, alone.train, config), []
    after = adapt(before, alone, config, seen.append).gaussians
    losses = [photometric_loss(render(before, view.camera).image, view.image).item() for view in alone.train]
    view = alone.train[min(range(2), key=lambda k: abs(losses[k] - seen[0].loss))]
    assert seen[0].loss == pytest.approx(min(losses, key=lambda loss: abs(loss - seen[0].loss)), rel=1e-5)
    kept = render(before, view.camera).kept
    rates = {
        "means": config.lr_means * before.log_scales.mean(1).exp()[kept], "quats": config.lr_quats,
        "log_scales": config.lr_scales, "sh0": config.lr_sh0,
    }  # fmt: skip
    for name, rate in rates.items():
        old, new = getattr(before, name), getattr(after, name)
        assert torch.equal(old[~kept], new[~kept]), name
        moved = (new - old)[kept].abs().flatten(1).amax(1) / rate
        assert (moved > 0).sum() > 20 and moved.max() == pytest.approx(1, rel=0.05), name  # positions are rounded
    moved = (after.sigma_d / before.sigma_d).log().abs()
    assert moved.max() == pytest.approx(config.lr_sigma, rel=1e-3) and (moved[~kept] < 1e-5).all()
    assert photometric_loss(render(after, view.camera).image, view.image) < seen[0].loss


@pytest.mark.parametrize("changes", [{"count_term": "paper"}, {"weight_slope": 1.0}], ids=str)
def test_steps_at_0_and_beyond_max_sv(captured: Pair, changes: dict[str, Any]) -> None:
    """Every form of the objective trains there; no weight rises beyond max_sv."""
    base, scene = captured
    config = config_of(iters=12, max_sv=4.0, full_share=0.5, **changes)
    drawn = [ViewSampler(scene.train, config).draw(k, 0.0).dial for k in range(12)]
    assert min(drawn) == 0 and (max(drawn) > 4 or config.count_term == "paper")
    assert loss_weight(5.0, config) <= loss_weight(4.0, config)
    found = adapt(base, scene, config)
    assert found.steps == 12 and not found.failed


def test_batch_gradient_is_the_sum_over_views(captured: Pair) -> None:
    """The first step is longer by the square root of the batch size."""
    base, scene = captured
    begun, views = initialize(base, scene.train, config_of()), scene.train[:2]
    config = config_of(batch=2)
    run = Trainer(begun, views, config)
    draws = [Sample(view, s) for view, s in zip(views, (1.0, 2.0), strict=True)]
    one, two = (run.objective.gradient_sum(run.parameters, [draw]) for draw in draws)
    both = run.objective.gradient_sum(run.parameters, draws)
    assert both.loss == one.loss + two.loss and torch.equal(both.kept, one.kept | two.kept)
    for name in run.stepped:
        assert torch.equal(both.gradients[name], one.gradients[name] + two.gradients[name]), name
    before = run.parameters["sh0"].clone()
    run.step(0.0)
    longest = (run.parameters["sh0"] - before).abs().max()
    assert longest == pytest.approx(2**0.5 * config.lr_sh0, rel=1e-2) and run.sampler.order == []


def test_only_the_first_rows_are_trained(captured: Pair) -> None:
    """Other rows are drawn and returned unchanged; resuming from a state gives the same bits."""
    base, scene = captured
    begun, few = initialize(base, scene.train, config_of()), len(base) // 3
    states: dict[int, TrainingState] = {}
    config = config_of(iters=20, average=0.5)
    found = adapt(begun, scene, config, states_of({5}, states), subset=TrainableSubset(few)).gaussians
    for name, value in found.tensors().items():
        rounding = 1e-6 if name == "sigma_d" else 0.0  # its logarithm is what training holds
        torch.testing.assert_close(value[few:], begun.tensors()[name][few:], rtol=rounding, atol=0.0)
        assert not torch.equal(value[:few], begun.tensors()[name][:few]), name
    assert_equal(adapt(begun, scene, config, None, states[5], subset=TrainableSubset(few)).gaussians, found)
    without = adapt(begun.select(torch.arange(few)), scene, config, subset=TrainableSubset(few)).gaussians
    assert not torch.equal(without.sh0, found.sh0[:few])


@pytest.mark.parametrize("dial", [1.0, 2.0])
@pytest.mark.parametrize("parameter", ["log", "linear"])
@pytest.mark.parametrize("part", [{}, {"full_context": True}, {"total": 900}], ids=str)
def test_compiled_steps_have_the_gradients_of_plain_ones(
    captured: Pair, monkeypatch: pytest.MonkeyPatch, part: dict[str, Any], parameter: str, dial: float
) -> None:
    base, scene = captured
    config = config_of(max_sv=4.0, parameter=parameter, lr_shN=1e-3)
    run = Trainer(initialize(base, scene.train, config), scene.train, config, TrainableSubset(len(base) - 20, **part))
    run.parameters["growth_d"] = torch.linspace(-0.5, 1, len(base))
    sample = Sample(scene.train[0], dial, 3.0)
    compiled = run.objective.gradient_sum(run.parameters, [sample])
    monkeypatch.setitem(BACKENDS, "cpu", lambda: Rasterizer(cpu.rasterize))
    plain = run.objective.gradient_sum(run.parameters, [sample])
    assert float(compiled.loss) == pytest.approx(float(plain.loss), rel=1e-3)
    assert int((compiled.kept != plain.kept).sum()) <= 1
    for name, want in plain.gradients.items():  # an alpha of 1/255 more or less changes a few
        assert float((compiled.gradients[name] - want).norm()) < 0.02 * float(want.norm()), name


@pytest.mark.parametrize("context", [0, 5], ids=["all rows", "rows of a block"])
def test_gradient_of_growth_equals_finite_differences(monkeypatch: pytest.MonkeyPatch, context: int) -> None:
    """In float64, at a dial value of its own; the context of a block does not grow."""
    monkeypatch.setitem(BACKENDS, "cpu", lambda: Rasterizer(reference.rasterize))
    count, config = 12, config_of(start="identity", max_sv=4.0)
    some = gaussians(count, 1, 0, size=0.3)
    begun = initialize(some, views := photograph(some, ring(2, 16, 12)), config)
    run = Trainer(begun, views, config, TrainableSubset(count - context, full_context=context > 0))
    exact = {name: value.double() for name, value in run.parameters.items()}
    exact["growth_d"] = torch.linspace(-0.5, 1.2, count, dtype=torch.float64)

    def of(growth_d: Tensor) -> GradientSum:
        return run.objective.gradient_sum(exact | {"growth_d": growth_d}, [Sample(views[0], 2.0)])

    plain = replace(run.objective, config=replace(config, growth="off"))
    none = {name: value for name, value in exact.items() if name != "growth_d"}
    ungrown = plain.gradient_sum(none, [Sample(views[0], 2.0)]).loss
    assert of(torch.zeros(count)).loss == ungrown != of(exact["growth_d"]).loss
    found, step = of(exact["growth_d"]), 1e-6 * torch.eye(count, dtype=torch.float64)
    slopes = [(of(exact["growth_d"] + row).loss - of(exact["growth_d"] - row).loss) / 2e-6 for row in step]
    wanted = loss_weight(2.0, config) * torch.tensor(slopes, dtype=torch.float64)
    assert (wanted[: count - context].abs() > 1e-5).sum() > 3 and not wanted[count - context :].any()
    torch.testing.assert_close(found.gradients["growth_d"], wanted[: count - context], rtol=1e-4, atol=1e-8)


def test_trained_growth_stays_in_its_range(captured: Pair) -> None:
    found = adapt(*captured, config_of(iters=4, lr_growth=1e3, average=0.0)).gaussians.growth_d
    assert found is not None and (found.min(), found.max()) == GROWTH_RANGE


def test_steps_use_the_sampled_views_and_dial_values(captured: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[Any] = []
    count = objective.count_gradient_at

    class Watched(type(cpu.RASTERIZER)):  # type: ignore[misc]
        def draw(self, g: Gaussians, view: Camera, s: float, **more: Any) -> Any:
            taken.extend([s] if g.sigma_d is not None else [])
            return super().draw(g, view, s, **more)

    monkeypatch.setitem(BACKENDS, "cpu", lambda: Watched(cpu.rasterize))
    monkeypatch.setattr(objective, "count_gradient_at", lambda *a: taken.append(a[3]) or count(*a))
    monkeypatch.setattr(objective, "photometric_loss", lambda *a: taken.append(id(a[1])) or photometric_loss(*a))
    config = config_of(iters=14, max_sv=4.0)
    monkeypatch.setattr(Gate, "check", lambda *_: None)
    monkeypatch.setattr(Gate, "finish", lambda *_: None)
    adapt(with_dial(gaussians(5, 0, 0), torch.ones(5)), captured[1], config)
    sampler = ViewSampler(captured[1].train, config)
    draws = [sampler.draw(k, k / 14) for k in range(14)]
    rendered = [x for view, s, *_ in draws for x in (s, id(view.image))]
    counted = [x for _, s, beyond, _ in draws for x in (s, beyond) if x >= 1]
    assert sorted(map(str, taken)) == sorted(map(str, [*rendered, *counted]))


def test_counts_are_at_typical_distances(captured: Pair) -> None:
    """Times the loss, the count term has the same gradient in all views, however near their cameras are."""
    base, scene = captured
    config = config_of(reg_weight=1e3)
    run = Trainer(initialize(base, scene.train, config), scene.train, config)
    plain = replace(run.objective, config=replace(config, reg_weight=0.0))
    terms = []
    for view in scene.train[:3]:
        one, other = (each.gradient_sum(run.parameters, [Sample(view, 2.0)]) for each in (run.objective, plain))
        terms.append((one.gradients["log_sigma"] - other.gradients["log_sigma"]) / one.loss)
    assert (terms[0].abs() > 1e-5).sum() > 20
    for term in terms[1:]:
        torch.testing.assert_close(term, terms[0], rtol=1e-3, atol=1e-6)
