"""The dial as a component of a loop of one's own."""

import numpy as np
import pytest
import torch
from refusals import refused
from torch.testing import assert_close

import clod_adapter as clod
from clod_adapter import AdaptConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.losses import photometric_loss
from clod_adapter.training.dial import SIGMA_RANGE, attach
from clod_adapter.training.schedule import OURS, Sample
from clod_adapter.training.trainer import Trainer
from scenes import splatfacto_parameters

MAX_SV = 5.0


def trainable(base, form="gsplat"):
    """Copies of the Gaussians' tensors as a trainer holds them."""
    named = clod.to_gsplat(base) if form == "gsplat" else splatfacto_parameters(base)
    return torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value.clone()) for name, value in named.items()}
    )


def loss_of(dial, scene, s):
    image = clod.render(dial.gaussians(), scene.train[0].camera, s).image
    return photometric_loss(image, scene.train[0].image, dial.config.ssim_weight)


def test_the_objective_is_that_of_adapt(captured):
    """All gradients, of the splats too, at one view and dial value."""
    base, scene = captured
    splats = trainable(base)
    s = 2.3
    dial = attach(splats, scene, seed=3)
    # the first is of the dial values
    counted = (OURS.counted * MAX_SV) ** np.random.default_rng(3).random(2)[1]
    dial.loss(s, loss_of(dial, scene, s)).backward()
    run = Trainer(dial.gaussians(), scene.train, AdaptConfig(lr_shN=1e-3))
    names = {"log_scales": "scales", "opacity_logits": "opacities"}
    for name, gradient in run.gradient_sum([Sample(scene.train[0], s, counted)]).gradients.items():
        leaf = getattr(dial, name, None)
        leaf = splats[names.get(name, name)] if leaf is None else leaf
        largest = float(gradient.abs().max())
        assert largest > 0, name
        assert_close(leaf.grad, gradient, rtol=1e-3, atol=1e-5 * largest, msg=name)
    term = dial.count_loss(s, torch.tensor(0.3))
    given = (base.opacity_logits, dial.sigma_d, dial.typical, s, dial.attenuation)
    kept = attenuate(*given).keep.float().mean().item()
    wanted = 0.3 * dial.config.reg_weight * (kept / dial.target_share(s) - 1) ** 2
    assert term.item() == pytest.approx(wanted, rel=1e-3)
    assert dial.count_loss(0.5, torch.tensor(0.3)) == 0 and dial.target_share(0.5) == 1


# of numbers read from tensors in a graph: the initialization needs none
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("form", ["gsplat", "splatfacto"])
def test_trainers_tensors_are_used_as_they_are(captured, form):
    base, scene = captured
    splats = trainable(base, form)
    dial = attach(splats, [view.camera for view in scene.train], growth="off")
    assert torch.equal(dial.log_sigma, attach(base, scene, growth="off").log_sigma)
    assert [name for name, _ in dial.named_parameters()] == ["log_sigma"] == list(dial.state_dict())
    loss_of(dial, scene, 2.0).backward()
    groups = {group["name"]: group["params"][0] for group in dial.param_groups(splats=True)}
    assert set(groups) == {"log_sigma", *splats}
    assert all(groups[name] is splats[name] and splats[name].grad is not None for name in splats)
    assert dial.gaussians().means.data_ptr() == splats["means"].data_ptr()


def test_rates_and_ranges_of_the_parameters(captured):
    base, scene = captured
    config = AdaptConfig(batch=4, lr_sh0=1.0)
    dial = attach(trainable(base), scene, config)
    rates = {group["name"]: group["lr"] for group in dial.param_groups(splats=True)}
    assert rates["sh0"] == 2 and rates["shN"] == 0 and rates["opacities"] == 2 * config.lr_opacities
    assert rates["log_sigma"] == 2 * config.lr_sigma and rates["growth_d"] == 2 * config.lr_growth
    grown = attach(
        dial.gaussians().replace(growth_d=torch.zeros(len(base)).requires_grad_()), scene
    )
    named = {group["name"]: group["params"][0] for group in grown.param_groups(splats=True)}
    assert named["growth_d"] is grown.growth_d  # and not the file's
    with torch.no_grad():
        dial.log_sigma[0], dial.log_sigma[1], dial.growth_d[0] = -100, 100, 9
    dial.sample()
    assert_close(dial.sigma_d[:2], torch.tensor(SIGMA_RANGE))
    assert dial.growth_d[0].item() == 3


def test_what_does_not_fit_is_refused(captured):
    base, scene = captured
    splats = trainable(base)
    dial = attach(splats, scene)
    splats.update(trainable(base.select(torch.arange(len(base)) < 5)))
    for call, message in (
        (lambda: attach(base, scene, form="paper"), "call adapt"),
        (lambda: attach(base, []), "no training views"),
        (
            lambda: attach({"means": base.means}, scene),
            "needs quats, scales, opacities, sh0 too, it has means",
        ),
        (dial.gaussians, "5 splats now, but the dial is for 300"),
        (
            lambda: attach(base, scene).param_groups(splats=True),
            "no splat requires a gradient: attach copies",
        ),
    ):
        with refused(message):
            call()
