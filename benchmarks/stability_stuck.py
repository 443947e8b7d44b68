"""Extreme initial values of sigma_d: Gaussians that cannot recover, and the objective after training.

Gaussians before a camera, whose right sigma_d spans eight decades, go through the training step, of sigma_d alone.

- ``stuck``: sigma_d starts at 0, ten thousand times too small and too large, and at SIGMA_MAX, a quarter each. A
  Gaussian cannot recover if no picture at any dial value has a gradient for it, and the count term has none in the
  needed direction, even with none (all) of the Gaussians kept.
- ``training``: all start ten thousand times too small: the objective, the mean over dial values of
  ``w_s L (1 + reg_weight (eta / target - 1)^2)``, before and after, and the same from the right start.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import clod_adapter as clod
from clod_adapter.equation.attenuation import SIGMA_MAX, attenuate
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.initialization.importance import sigma_from_importance
from clod_adapter.losses import photometric_loss
from clod_adapter.training.target_count import count_gradient, soft_count, target_curve
from clod_adapter.training.trainer import Trainer

import torch
from torch import Tensor

FROZEN = {f"lr_{name}": 0.0 for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
CONFIG = clod.AdaptConfig(growth="off", **FROZEN)
PAPER = clod.AdaptConfig.paper(tau=CONFIG.tau, cut=CONFIG.cut, normalizer=CONFIG.normalizer, **FROZEN)
STUCK_STEPS, TRAINING_STEPS = 100, 600
TINY = 1e-38  # 0 to the equation, whose eps is 1e-8, but not to a division
DIALS = tuple(CONFIG.max_sv ** (k / 11) for k in range(12))
METHODS: dict[str, tuple[clod.AdaptConfig, bool]] = {
    "paper: linear sigma under a relu": (PAPER, False),
    "the same with a floor of 1e-4": (PAPER, True),
    "ours without the count term": (replace(CONFIG, reg_weight=0.0), True),
    "ours, linear sigma": (replace(CONFIG, parameter="linear"), True),
    "ours": (CONFIG, True),
}


def stuck_rows() -> list[dict[str, Any]]:
    return [_stuck_row(name) for name in METHODS]


def _stuck_row(method: str) -> dict[str, Any]:
    config, floor = METHODS[method]
    right = scene()[0].sigma_d
    n = torch.arange(len(right))
    start = torch.stack([right * 0, right * 1e-4, right * 1e4, torch.full_like(right, SIGMA_MAX)])[n % 4, n]
    counts = [stuck(trained(config, start, steps, floor=floor)) for steps in (0, STUCK_STEPS)]
    return {"part": "stiffness", "what": "stuck", "method": method, "of": len(n), "start": counts[0], "end": counts[1]}


def training_rows() -> list[dict[str, Any]]:
    right = scene()[0].sigma_d
    rows = []
    for name, start in (("right", right), ("too small", right / 1e4)):
        before, after = (objective(trained(CONFIG, start, steps)) for steps in (0, TRAINING_STEPS))
        rows.append({"part": "stiffness", "what": "training", "from": name, "before": before, "after": after})
    return rows


def scene(n: int = 192, seed: int = 0) -> tuple[clod.Gaussians, clod.Camera]:
    """A grid of Gaussians in the picture, each in a place of its own, at distances d' from 1e-3 to 1e5, log-uniform.

    Their sigma_d is right for the target-count curve, in a random pruning order.
    """
    draw, across, pixels = torch.Generator().manual_seed(seed), 16, 3
    width, height, focal = across * pixels, n // across * pixels, 50.0
    camera = clod.Camera(
        torch.eye(4), torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]), width, height
    )
    k = torch.arange(n)
    at = torch.stack([k % across - (across - 1) / 2, k // across - (n // across - 1) / 2], 1) * pixels / focal
    rays = torch.cat([at, torch.ones(n, 1)], 1)
    unit = 100.0  # of d'; nothing may be nearer than the rasterizer's near plane
    depths = unit * 10 ** torch.empty(n).uniform_(-3, 5, generator=draw)
    logits = torch.empty(n).uniform_(0.3, 0.99, generator=draw).logit()
    some = clod.Gaussians(
        rays * depths[:, None], torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        (depths * 1.2 / focal).log()[:, None].repeat(1, 3), logits,
        torch.empty(n, 1, 3).uniform_(-1.5, 1.5, generator=draw), torch.empty(n, 0, 3),
    )  # fmt: skip
    settings = CONFIG.attenuation(unit)
    distances = normalized_distances(some.means, camera, settings)
    rank = torch.rand(n, generator=draw)
    right = sigma_from_importance(some, rank, distances, settings, share=CONFIG.share, exponent=CONFIG.exponent).clamp(
        max=1e6
    )
    return clod.with_dial(some, right, settings), camera


def trained(config: clod.AdaptConfig, start: Tensor, steps: int, *, floor: bool = True) -> Trainer:
    """``scene`` after so many steps of the training itself; without its floor under sigma_d, a relu may come to 0."""
    some, camera = scene()
    picture = (clod.render(some.replace(sigma_d=None, attenuation=None), camera).image.clamp(0, 1) * 255).round()
    settings = config.attenuation(some.attenuation.scene_distance)
    views = (clod.View(camera, picture.to(torch.uint8)),)
    run = Trainer(some.replace(sigma_d=start, attenuation=settings), views, config)
    if not floor:
        run.decay_range = (TINY, SIGMA_MAX)
        run.parameters[run.decay].copy_(start.clamp(min=TINY))
    for k in range(steps):
        run.step(k / steps)
    return run


@torch.no_grad()
def objective(run: Trainer) -> float:
    """What training minimises, at dial values evenly spread, for sigma_d as it would be handed out."""
    (view,), config, found, total = run.sampler.views, run.config, run.gaussians(), 0.0
    for s in DIALS:
        shown = clod.render(found, view.camera, s)
        weight = (1 - config.weight_slope * s / config.max_sv) ** 2
        off = float(shown.kept.float().mean()) / target_curve(s, config.share, config.exponent) - 1
        total += weight * float(photometric_loss(shown.image, view.image)) * (1 + config.reg_weight * off**2)
    return total / len(DIALS)


def stuck(run: Trainer) -> int:
    """Gaussians that cannot recover: no gradient from a picture, and none in the needed direction from the count term.

    A Gaussian that is culled at every dial value needs a negative gradient while none is kept; one that does not fade
    needs a positive gradient while all are kept.
    """
    p, config, camera, reading = run.parameters, run.config, run.sampler.views[0].camera, run.objective.attenuation
    distances = normalized_distances(p["means"], camera, reading)
    seen = out = raised = lowered = torch.zeros(len(distances), dtype=torch.bool)
    for s in DIALS:
        x = p[run.decay].detach().requires_grad_()
        now = attenuate(p["opacity_logits"], run.objective.sigma(x), distances, s, reading)
        seen = seen | (torch.autograd.grad(now.drawn.sum(), x, retain_graph=True)[0] != 0)
        if s == 1:
            out = ~now.keep
        if run.config.has_target_count:
            none, all_ = (
                count_gradient(now._replace(keep=kept), p["opacity_logits"], s, reading.tau, 1.0, config)
                for kept in (torch.zeros_like(now.keep), torch.ones_like(now.keep))
            )
            raised, lowered = raised | (none < 0), lowered | (all_ > 0)
        else:  # the paper's term never lowers it
            count = soft_count(now.log_opacities, s, reading.tau, config.temperature)
            lowered = lowered | (torch.autograd.grad(count, x)[0] != 0)
    return int((~seen & ~torch.where(out, raised, lowered)).sum())
