"""Everything that uses a dial, as functions of Gaussians that return tensors and numbers."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from clod_adapter import Gaussians, Hook, TrainableSubset, View, detach, dial_for, evaluate, render, with_dial
from clod_adapter.bake import bake, order_by_extinction
from clod_adapter.blocks.divide import block_target, context_rows, divide
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.evaluation.popping import dial_popping, path_popping
from clod_adapter.initialization.importance import initialize
from clod_adapter.training.schedule import Sample
from clod_adapter.training.trainer import Trainer
from scenes import gaussians, photograph, ring

N, DIAL = 120, 2.0
CAMERAS = ring(3, 24, 18)
CONFIG = AdaptConfig(max_sv=4.0)


def model_of(tau: float) -> Gaussians:
    sigma_d = 0.3 + 2 * torch.rand(N, generator=torch.Generator().manual_seed(1))
    settings = AttenuationConfig(tau=tau, scene_distance=4.0, reference_distance=4.0, max_sv=4.0)
    return with_dial(gaussians(N, 1, 0, size=0.15), sigma_d, settings, torch.linspace(-0.5, 1, N))


def views_of(model: Gaussians) -> tuple[View, ...]:
    return photograph(detach(model).cpu(), CAMERAS)


def rendering(model: Gaussians) -> list[Any]:
    found = render(model, CAMERAS[0], DIAL)
    return [found.image, found.alpha, found.kept]


def evaluation(model: Gaussians) -> list[Any]:
    rows = evaluate(model, views_of(model), [1.0, DIAL])
    return [value for row in rows for value in (row.psnr, row.ssim, row.kept, row.in_view)]


def objective(config: AdaptConfig, trained: int = N, **part: Any) -> Callable[[Gaussians], list[Any]]:
    def gradients(model: Gaussians) -> list[Any]:
        begun = model.replace(growth_d=None) if config.growth == "off" else model
        run = Trainer(begun, views_of(model), config, TrainableSubset(trained, **part))
        found = run.gradient_sum([Sample(views_of(model)[0], DIAL, 3.0)])
        return [found.loss, found.kept, *found.gradients.values()]

    return gradients


def budget(**given: Any) -> Callable[[Gaussians], list[Any]]:
    return lambda model: [dial_for(model, keep=float(n), **given).virtual_scale for n in (20, 25)]


def baked(**given: Any) -> Callable[[Gaussians], list[Any]]:
    return lambda model: list(bake(model, DIAL, **given).tensors().values())


def hook(model: Gaussians) -> list[Any]:
    own = model.cpu()  # the hook follows the means
    dialled = Hook(own.sigma_d, own.attenuation, DIAL, own.growth_d)  # type: ignore[arg-type]
    return list(dialled(model.means, model.opacities, CAMERAS[0].viewmat))


def blocks(model: Gaussians) -> list[Any]:
    """A block's context, and its target share."""
    views = views_of(model)
    division = divide(initialize(model, views, CONFIG), views, CONFIG, 2)
    share = block_target(division, 0, CAMERAS, CONFIG, first=False)(DIAL)
    return [*(context_rows(division, 0, views, after).double().mean() for after in (None, model)), *share]


def popping(model: Gaussians) -> list[Any]:
    return [dial_popping(model, CAMERAS[0], DIAL, steps=2).mean, path_popping(model, CAMERAS[:2], DIAL, steps=2).mean]


CONSUMERS: dict[str, Callable[[Gaussians], list[Any]]] = {
    "render": rendering,
    "evaluate": evaluation,
    "objective": objective(CONFIG),
    "objective of a block": objective(CONFIG, trained=N // 2, full_context=True),
    "the paper's objective": objective(AdaptConfig.paper(max_sv=4.0)),
    "dial_for one camera": budget(cameras=CAMERAS[:1]),
    "dial_for several cameras": budget(cameras=CAMERAS),
    "dial_for a baked file": budget(cameras=CAMERAS, baked=True),
    "bake for one camera": baked(camera=CAMERAS[0]),
    "bake for several cameras": baked(cameras=CAMERAS),
    "Hook": hook,
    "popping": popping,
    "blocks": blocks,
    "order_by_extinction": lambda model: [order_by_extinction(model, CAMERAS)],
}


def same(these: list[Any], those: list[Any]) -> bool:
    pairs = list(zip(these, those, strict=True))
    return all(torch.equal(a, b) if isinstance(a, Tensor) else a == b for a, b in pairs)
