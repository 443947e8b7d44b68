"""One function decides what is drawn: change its threshold or its growth, and everything that uses a dial follows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from clod_adapter.adapter import detach, with_dial
from clod_adapter.bake import bake, order_by_extinction
from clod_adapter.blocks.divide import block_target, context_rows, divide
from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.equation import attenuation, growth
from clod_adapter.equation.extinction import extinction_scale, sigma_for_extinction
from clod_adapter.evaluation.budget import dial_for
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.evaluation.popping import dial_popping, path_popping
from clod_adapter.gaussians import Gaussians
from clod_adapter.hook import Hook
from clod_adapter.initialization.importance import initialize, sigma_from_importance
from clod_adapter.rasterizers import BACKENDS, Rasterizer, cpu
from clod_adapter.render import render
from clod_adapter.training.dial import TrainableSubset
from clod_adapter.training.schedule import Sample
from clod_adapter.training.trainer import Trainer
from clod_adapter.viewer.payload import Payload
from scenes import gaussians, photograph, ring

N, DIAL = 120, 2.0
TAU, RAISED = 0.02, 0.2
CAMERAS = ring(3, 24, 18)


def model_of(tau: float) -> Gaussians:
    sigma_d = 0.3 + 2 * torch.rand(N, generator=torch.Generator().manual_seed(1))
    settings = AttenuationConfig(tau=tau, scene_distance=4.0, reference_distance=4.0, max_sv=4.0)
    growth_d = torch.linspace(-0.5, 1, N)
    return with_dial(gaussians(N, 1, 0, size=0.15), sigma_d, settings, growth_d)


def views_of(model: Gaussians) -> tuple[View, ...]:
    return photograph(detach(model), CAMERAS)


def rendering(model: Gaussians) -> list[Tensor]:
    found = render(model, CAMERAS[0], DIAL)
    return [found.image, found.alpha, found.kept]


def evaluation(model: Gaussians) -> list[Any]:
    return [(row.psnr, row.ssim, row.kept, row.in_view) for row in evaluate(model, views_of(model), [1.0, DIAL])]


def objective(config: AdaptConfig, trained: int = N, **part: Any) -> Callable[[Gaussians], list[Any]]:
    def gradients(model: Gaussians) -> list[Any]:
        begun = model.replace(growth_d=None) if config.growth == "off" else model
        run = Trainer(begun, views_of(model), config, TrainableSubset(trained, **part))
        found = run.gradient_sum([Sample(views_of(model)[0], DIAL, 3.0)])
        return [found.loss, found.kept, *found.gradients.values()]

    return gradients


def budget(**given: Any) -> Callable[[Gaussians], list[float]]:
    def solved(model: Gaussians) -> list[float]:
        return [dial_for(model, keep=float(share), **given).virtual_scale for share in (20, 25)]

    return solved


def baked(**given: Any) -> Callable[[Gaussians], list[Tensor]]:
    return lambda model: list(bake(model, DIAL, **given).tensors().values())


def hook(model: Gaussians) -> list[Tensor]:
    assert model.attenuation is not None and model.sigma_d is not None
    view, dialled = CAMERAS[0], Hook(model.sigma_d, model.attenuation, DIAL, model.growth_d)
    return list(dialled(model.means, model.opacities, view.viewmat))


def blocks(model: Gaussians) -> list[Any]:
    """A block's context, and its target share."""
    views, config = views_of(model), AdaptConfig(max_sv=4.0)
    division = divide(initialize(model, views, config), views, config, 2)
    target = block_target(division, 0, CAMERAS, config, first=False)
    context = [context_rows(division, 0, views, after) for after in (None, model)]
    return [*context, target(DIAL)]


def popping(model: Gaussians) -> list[Any]:
    return [dial_popping(model, CAMERAS[0], DIAL, steps=2), path_popping(model, CAMERAS[:2], DIAL, steps=2)]


def order(model: Gaussians) -> list[Tensor]:
    return [order_by_extinction(model, CAMERAS)]


def extinction(model: Gaussians) -> list[Tensor]:
    assert model.attenuation is not None and model.sigma_d is not None
    given = model.opacity_logits, torch.full((N,), 0.8), model.attenuation
    scale = extinction_scale(given[0], model.sigma_d, *given[1:])
    return [scale, sigma_for_extinction(given[0], given[1], torch.full((N,), DIAL), given[2])]


def initialization(model: Gaussians) -> list[Tensor]:
    assert model.attenuation is not None
    distances = torch.full((N,), 0.8)
    return [sigma_from_importance(model, model.opacities, distances, model.attenuation, share=0.7, exponent=1.5)]


CONSUMERS: dict[str, Callable[[Gaussians], list[Any]]] = {
    "render": rendering,
    "evaluate": evaluation,
    "objective": objective(AdaptConfig(max_sv=4.0)),
    "objective of a block": objective(AdaptConfig(max_sv=4.0), trained=N // 2, full_context=True),
    "the paper's objective": objective(AdaptConfig.paper(max_sv=4.0)),
    "dial_for one camera": budget(cameras=CAMERAS[:1]),
    "dial_for several cameras": budget(cameras=CAMERAS),
    "dial_for a baked file": budget(cameras=CAMERAS, baked=True),
    "bake for one camera": baked(camera=CAMERAS[0]),
    "bake for several cameras": baked(cameras=CAMERAS),
    "Hook": hook,
    "popping": popping,
    "blocks": blocks,
    "order_by_extinction": order,
    "extinction": extinction,
    "initialization": initialization,
}


# Growth is no part of the culling rule, and none of the paper's form.
WITHOUT_GROWTH = (
    "order_by_extinction", "extinction", "initialization", "the paper's objective", "dial_for one camera",
    "dial_for several cameras", "dial_for a baked file",
)  # fmt: skip


def same(these: list[Any], those: list[Any]) -> bool:
    pairs = list(zip(these, those, strict=True))
    return all(torch.equal(a, b) if isinstance(a, Tensor) else a == b for a, b in pairs)


@pytest.mark.parametrize("name", CONSUMERS)
def test_everything_follows_the_culling_threshold(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A threshold of 10 tau s gives, to the bit, what a tenfold tau gives."""
    consumer = CONSUMERS[name]
    before, wanted = consumer(model_of(TAU)), consumer(model_of(RAISED))
    assert not same(before, wanted)
    # The function's own code, as an edit of its source would change it for whoever has imported it.
    changed = (lambda tau, virtual_scale: (10 * tau) * virtual_scale).__code__
    monkeypatch.setattr(attenuation.culling_threshold, "__code__", changed)
    assert 10 * TAU == RAISED and same(consumer(model_of(TAU)), wanted)


@pytest.mark.parametrize("name", CONSUMERS)
def test_everything_grows_by_one_function(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other factors change whatever draws, and nothing that counts or culls.

    By the default ``draw``: the CPU's kernels override it (tests/rasterizers/test_dial.py compares the two).
    """
    monkeypatch.setitem(BACKENDS, "cpu", lambda: Rasterizer(cpu.rasterize))
    consumer = CONSUMERS[name]
    before = consumer(model_of(TAU))
    monkeypatch.setattr(
        growth.growth_factors, "__code__", (lambda growth_d, d, s, r: (3 * growth_d.to(d)).exp()).__code__
    )
    assert same(consumer(model_of(TAU)), before) == (name in WITHOUT_GROWTH)


def test_the_viewer_takes_the_settings_of_the_file() -> None:
    """Its shaders have an equation of their own, checked against golden values; the settings are the file's."""
    model = model_of(TAU)
    raised = Payload("model.ply", model.replace(attenuation=replace(model.attenuation, tau=RAISED)))  # type: ignore[type-var]
    assert f"tau {RAISED}\n".encode() in raised.header and raised.header != Payload("model.ply", model).header
