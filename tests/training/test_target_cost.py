"""The cost term: its model of a frame's work, and the gradients that follow from it."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from clod_adapter.adapter import ATTRIBUTES, detach, with_dial
from clod_adapter.blocks.divide import check_divisible
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.equation.distances import typical_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Phase, Progress
from clod_adapter.rasterizers import cpu
from clod_adapter.training.loop import adapt
from clod_adapter.training.objective import TrainableSubset
from clod_adapter.training.target_cost import EXPONENT, TargetCost, view_cost
from clod_adapter.training.target_count import target_curve
from scenes import gaussians, photograph, ring

N = 400
CAMERAS = ring(4, 96, 80)
CONFIG = AdaptConfig(max_sv=4.0, iters=30, target="cost", start_share=0.8)


@pytest.fixture(scope="module")
def model() -> Gaussians:
    """Gaussians with a dial, at which some are culled at every dial value."""
    sigma_d = 0.1 + 4.0 * torch.rand(N, generator=torch.Generator().manual_seed(1))
    settings = AttenuationConfig(scene_distance=4.0, reference_distance=4.0, max_sv=4.0)
    return with_dial(gaussians(N, 0, 0, size=0.08), sigma_d, settings, torch.full((N,), 0.2))


def parameters_of(model: Gaussians) -> dict[str, torch.Tensor]:
    assert model.sigma_d is not None and model.growth_d is not None
    values = {name: getattr(model, name) for name in ATTRIBUTES}
    return values | {"log_sigma": model.sigma_d.log(), "growth_d": model.growth_d}


def test_work_follows_pixels_and_stops_behind_what_is_opaque() -> None:
    """A Gaussian of twice the size has more blocks; behind an opaque wall it has none."""
    view = CAMERAS[0]
    forward = view.viewmat[2, :3]
    near, far = view.position + 2 * forward, view.position + 4 * forward

    def model(size: float, wall: bool) -> Gaussians:
        scales = torch.tensor([[size] * 3, [3.0] * 3] if wall else [[size] * 3]).log()
        n = len(scales)
        quats = torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4)
        means = torch.stack([far, near][:n])
        return Gaussians(means, quats, scales, torch.full((n,), 20.0), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3))

    tiles, blocks = cpu.work(model(0.1, False), view)
    more_tiles, more_blocks = cpu.work(model(0.2, False), view)
    assert more_blocks[0] > 2 * blocks[0] > 0 and more_tiles[0] >= tiles[0] > 0
    # The wall takes alpha 0.999 a layer: a second one would end every pixel.
    two = model(0.1, True).select(torch.tensor([0, 1, 1]))
    assert cpu.work(two, view)[1][0] == 0


def test_the_model_is_the_measured_cost_of_the_base(model: Gaussians) -> None:
    """With a dial that has no effect, the modelled costs are those of the renderings."""
    cost = TargetCost(model, CAMERAS, CONFIG)
    opaque = attenuate(model.opacity_logits, None, torch.ones(N), 1.0, None)
    modelled = cost.modelled(opaque, model.log_scales).sum()
    measured = sum(view_cost(detach(model), camera) for camera in CAMERAS) / len(CAMERAS)
    assert float(modelled) == pytest.approx(measured, rel=0.02)  # opacities near 1/255 differ
    assert cost.total == pytest.approx(measured, rel=1e-5)


def test_a_measurement_corrects_the_model(model: Gaussians) -> None:
    """After it, the corrected share is the share of the renderings; the next one is due a fifth later."""
    cost = TargetCost(model, CAMERAS, CONFIG)
    typical = typical_distance(model.means, CAMERAS, model.attenuation)  # type: ignore[arg-type]
    cost.measure(model, typical, 0.0)
    assert float(cost.measured[0]) == pytest.approx(0.2)
    for s in (1.0, 2.0, 4.0):
        dialled = attenuate(model.opacity_logits, model.sigma_d, typical, s, model.attenuation, growth_d=model.growth_d)
        share = float(cost.modelled(dialled, model.log_scales).sum()) / cost.total * cost.factor(s)
        whole = sum(view_cost(detach(model), camera) for camera in CAMERAS)
        assert share == pytest.approx(sum(view_cost(model, camera, s) for camera in CAMERAS) / whole, rel=1e-4)
    factors = cost.measured.clone()
    if cost.due(0.19):
        cost.measure(model.replace(log_scales=model.log_scales + 1), typical, 0.19)
    assert torch.equal(cost.measured, factors) and cost.due(0.2)
    cost.measure(model.replace(log_scales=model.log_scales + 1), typical, 0.2)
    assert not torch.equal(cost.measured, factors)


def test_the_curve_begins_at_the_cost_of_the_initial_dial(model: Gaussians) -> None:
    """At s = 1 nothing is penalised then, whatever the share of the Gaussians; later measurements leave it there."""
    cost, settings = TargetCost(model, CAMERAS, CONFIG), model.attenuation
    assert settings is not None
    typical, rows = typical_distance(model.means, CAMERAS, settings), parameters_of(model)
    cost.measure(model, typical, 0.0)
    whole = sum(view_cost(detach(model), camera) for camera in CAMERAS)
    share = sum(view_cost(model, camera, 1.0) for camera in CAMERAS) / whole
    assert 0.5 < share < 1 and abs(share - CONFIG.share) > 0.02, "the test needs another share than the config's"
    assert float(cost.measured[1]) == pytest.approx(share)
    at_one, far = (cost.gradients(rows, typical, s, 1.0, settings, CONFIG) for s in (1.0, 4.0))
    assert all(float(at_one[name].abs().max()) < 1e-3 * float(far[name].abs().max()) for name in far)
    cost.measure(model.replace(log_scales=model.log_scales - 1), typical, 0.2)
    assert float(cost.measured[1]) == pytest.approx(share)


@pytest.mark.parametrize(("opacity", "share"), [(-9.0, 0.5), (9.0, 1.0)])
def test_where_the_curve_may_begin(model: Gaussians, opacity: float, share: float) -> None:
    """Of an initial dial that keeps nothing, or nearly everything."""
    cost = TargetCost(model, CAMERAS, CONFIG)
    typical = typical_distance(model.means, CAMERAS, model.attenuation)  # type: ignore[arg-type]
    cost.measure(model.replace(opacity_logits=torch.full((N,), opacity), sigma_d=torch.full((N,), 1e4)), typical, 0.0)
    assert float(cost.measured[1]) == share


def test_factors_between_dial_values(model: Gaussians) -> None:
    cost = TargetCost(model, CAMERAS, CONFIG)
    cost.measured[2:] = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0])
    assert [cost.factor(4.0**k) for k in (0, 0.125, 0.25, 1.0)] == pytest.approx([1.0, 1.5, 2.0, 5.0])
    assert cost.factor(6.0) == pytest.approx(5.0)  # counted beyond max_sv


@pytest.mark.parametrize("above", [True, False])
def test_gradients(model: Gaussians, above: bool) -> None:
    """Above the target, smaller scales and growth, a smaller sigma and larger opacities follow; below it, the opposite.

    Those by scales and growth are the derivatives of the penalty.
    """
    cost = TargetCost(model, CAMERAS, CONFIG)
    s, assumed = 2.0, model.attenuation
    assert assumed is not None
    typical = typical_distance(model.means, CAMERAS, assumed)
    rows = parameters_of(model)

    def share(growth_d: torch.Tensor) -> torch.Tensor:
        dialled = attenuate(model.opacity_logits, model.sigma_d, typical, s, assumed, growth_d=growth_d)
        return cost.modelled(dialled, model.log_scales).sum() / cost.total

    now = float(share(rows["growth_d"]))
    cost.measured[2:] = target_curve(s, CONFIG.share, EXPONENT) / now * (1.5 if above else 0.5)
    found = cost.gradients(rows, typical, s, 1.0, assumed, CONFIG)
    sign = 1 if above else -1
    kept = attenuate(model.opacity_logits, model.sigma_d, typical, s, assumed).keep
    assert 20 < int(kept.sum()) < N - 20
    for name, towards in (("log_scales", 1), ("growth_d", 1), ("log_sigma", 1), ("opacity_logits", -1)):
        assert (sign * towards * found[name] >= 0).all() and found[name].abs().sum() > 0
    assert (found["log_scales"][~kept] == 0).all()
    step = 1e-3
    slope = (share(rows["growth_d"] + step) - share(rows["growth_d"] - step)) / (2 * step)
    target = target_curve(s, CONFIG.share, EXPONENT)
    penalty = 2 * CONFIG.reg_weight * (now * cost.factor(s) / target - 1) / target
    assert float(found["growth_d"].sum()) == pytest.approx(float(slope) * penalty, rel=1e-2)


def test_training_lowers_the_cost_of_frames(model: Gaussians) -> None:
    """Against the same training by counts; and the far end takes less than s = 1."""
    base = gaussians(N, 0, 0, size=0.15)
    scene = Scene(photograph(base, CAMERAS), ())
    shares = {}
    for target in ("count", "cost"):
        found = adapt(base, scene, replace(CONFIG, target=target, iters=60)).gaussians
        shares[target] = [sum(view_cost(found, camera, s) for camera in CAMERAS) for s in (1.0, 4.0)]
    assert shares["cost"][1] < 0.9 * shares["count"][1]
    assert shares["cost"][1] < 0.6 * shares["cost"][0]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(photograph(gaussians(N, 0, 0, size=0.15), CAMERAS), ())


def test_resumed_training_has_the_same_bits(scene: Scene) -> None:
    """Also between two measurements, whose factors the state has."""
    base, states = gaussians(N, 0, 0, size=0.15), []

    def listen(now: Progress) -> bool:
        if now.phase == Phase.TRAINING and now.done == 9 and now.state:
            states.append(copy.deepcopy(now.state()))
        return True

    whole = adapt(base, scene, CONFIG, listen).gaussians
    assert float(states[0].tensors["cost.measured"][0]) == pytest.approx(0.4)
    resumed = adapt(base, scene, CONFIG, resume=states[0]).gaussians
    assert all(torch.equal(value, resumed.tensors()[name]) for name, value in whole.tensors().items())


def test_what_is_frozen_stays(scene: Scene) -> None:
    base = gaussians(N, 0, 0, size=0.15)
    found = adapt(base, scene, replace(CONFIG, lr_scales=0.0, growth="off")).gaussians
    assert torch.equal(found.log_scales, base.log_scales) and found.growth_d is None


def test_views_in_which_nothing_is_drawn() -> None:
    """Costs of 0 are no error: the term has no effect then."""
    faint = gaussians(N, 0, 0).replace(opacity_logits=torch.full((N,), -9.0))
    assert adapt(faint, Scene(photograph(faint, CAMERAS), ()), replace(CONFIG, iters=2)).steps == 2


def test_a_subset_is_refused(scene: Scene) -> None:
    with pytest.raises(ClodError, match="needs all Gaussians trained"):
        adapt(gaussians(N, 0, 0), scene, CONFIG, subset=TrainableSubset(N // 2))


def test_settings_that_it_needs() -> None:
    for changed in ({"count_term": "paper"}, {"parameter": "linear"}):
        with pytest.raises(ClodError, match="target is cost, it must be count, as cost needs"):
            AdaptConfig(target="cost", **changed)
    with pytest.raises(ClodError, match="target cost cannot be trained in blocks"):
        check_divisible(CONFIG)
