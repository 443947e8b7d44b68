"""The target-cost curve: the share of the base's rendering work at each dial value, and the term that enforces it.

A count treats a speck and a wall alike; the time of a frame does not. The cost of a Gaussian in a view is what the
CPU's rasterizer does for it, in units of one block of 4x4 pixels::

    cost = DRAWN [it is drawn] + TILE tiles + blocks

Blocks that are opaque already blend no more, so a cost depends on what is in front. The weights are fitted to measured
times (benchmarks/cost.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter._support.fusing import Number
from clod_adapter.cameras import Camera
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.equation.attenuation import Attenuated, attenuate, culling_threshold
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import FADING
from clod_adapter.rasterizers.protocol import ALPHA_MIN
from clod_adapter.training.target_count import lifted_slope, target_curve

CPU = torch.device("cpu")
DRAWN, TILE = 5.0, 6.0
EXPONENT = 1.0  # of the curve
# Dial values and views at which shares are measured, and how often in a training.
DIALS, VIEWS, MEASURED = 5, 6, 5
SHARES = 0.5, 1.0  # of the cost at s = 1, where the curve may begin; below a half it would rise from there
# An opaque Gaussian hides what is behind it, where blocks end sooner: that saves more than its larger ellipse costs.
HIDING = 1.0
CHANGING = ("opacity_logits", "log_scales", "log_sigma", "growth_d")  # what the cost is a function of
MOST = 4.0  # of a correction, or its inverse: with hardly any Gaussian left at a dial value, shares say nothing
FAINTEST = 0.3  # lower bound of log(a / ALPHA_MIN), in which an ellipse's area is proportional


def view_cost(gaussians: Gaussians, camera: Camera, virtual_scale: float = 1.0) -> float:
    """The cost of a frame."""
    fixed, blocks = _costs(gaussians, camera, virtual_scale)
    return float(fixed.double().sum() + blocks.double().sum())


def _costs(gaussians: Gaussians, camera: Camera, virtual_scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """``[N]`` the cost of each Gaussian, on the CPU, without its blocks; and these."""
    from clod_adapter.rasterizers import cpu

    tiles, blocks = cpu.work(gaussians, camera, virtual_scale)
    return (TILE * tiles + DRAWN) * (blocks > 0), blocks


class TargetCost:
    """The cost term of one training.

    The cost of a Gaussian at the dial value s is modelled from its mean cost over views of the base::

        cost_i(s) = fixed_i + blocks_i g^2 e^(2/3 t) log(255 a_d) / log(255 a)

    with a its opacity and b the sum of its log_scales in the base, a_d the drawn opacity and g the growth at the
    typical distance, t the sum of the log_scales less b: an ellipse ends where alpha is 1/255. The model
    ignores that fewer Gaussians hide less. So the share is measured in renderings, MEASURED times in a training, and
    corrected by one factor for each of some dial values. The curve begins at the share that the first measurement finds
    at s = 1, the cost of the Gaussians that the initial dial keeps there; within SHARES, as for counts.

    Args:
        base: its dial is ignored; cameras: of views, at least one.

    Attributes:
        fixed, blocks: ``[N]`` mean costs in the base; total: their sum, at least 1.
        log_scales, reach: ``[N]`` b, and log(255 a), at least FAINTEST.
        cameras: that shares are measured from; whole: the base's mean cost there.
        dials: the dial values that are measured.
        measured: ``[2 + DIALS]`` float64, the share of the training at which the next measurement is due; the share of
            the base's cost at s = 1, where the curve begins; and the factors.
    """

    def __init__(self, base: Gaussians, cameras: Sequence[Camera], config: AdaptConfig) -> None:
        plain = base.replace(sigma_d=None, attenuation=None, growth_d=None).to(CPU)
        self.fixed, self.blocks = torch.zeros_like(plain.opacity_logits), torch.zeros_like(plain.opacity_logits)
        for camera in cameras:
            for mean, cost in zip((self.fixed, self.blocks), _costs(plain, camera), strict=True):
                mean += cost / len(cameras)
        self.fixed, self.blocks = self.fixed.to(base.means.device), self.blocks.to(base.means.device)
        self.total = max(float(self.fixed.double().sum() + self.blocks.double().sum()), 1.0)
        self.log_scales, self.reach = base.log_scales.sum(1), _reach(base.opacities).clamp(min=FAINTEST)
        self.cameras = cameras[:: -(-len(cameras) // VIEWS)]
        self.whole = max(fmean(view_cost(plain, camera) for camera in self.cameras), 1.0)
        self.dials = [config.max_sv ** (k / (DIALS - 1)) for k in range(DIALS)]
        self.measured = torch.tensor([0.0, config.share] + [1.0] * DIALS, dtype=torch.float64)

    def due(self, share_done: float) -> bool:
        """Whether a measurement is due."""
        return share_done >= float(self.measured[0])

    @torch.no_grad()
    def measure(self, gaussians: Gaussians, typical: Tensor, share_done: float) -> None:
        """Compares the modelled share with that of renderings, at each dial value."""
        assert gaussians.sigma_d is not None and gaussians.attenuation is not None
        here, first = gaussians.to(CPU), float(self.measured[0]) == 0
        for k, s in enumerate(self.dials):
            cost = fmean(view_cost(here, camera, s) for camera in self.cameras)
            dialled = attenuate(
                gaussians.opacity_logits, gaussians.sigma_d, typical, s, gaussians.attenuation,
                growth_d=gaussians.growth_d,
            )  # fmt: skip
            modelled = float(self.modelled(dialled, gaussians.log_scales).sum()) / self.total
            if first and s == 1:
                self.measured[1] = min(max(cost / self.whole, SHARES[0]), SHARES[1])
            self.measured[2 + k] = min(max(cost / self.whole / max(modelled, 1e-9), 1 / MOST), MOST)
        self.measured[0] = math.floor(share_done * MEASURED + 1) / MEASURED

    def factor(self, virtual_scale: float) -> float:
        """The measured share over the modelled one, between the dial values linear in log s."""
        place = min(math.log(virtual_scale) / max(math.log(self.dials[-1]), 1e-9), 1.0) * (DIALS - 1)
        left = min(int(place), DIALS - 2)
        low, high = self.measured[2 + left : 4 + left].tolist()
        return low + (high - low) * (place - left)

    def modelled(self, dialled: Attenuated, log_scales: Tensor) -> Tensor:
        """``[N]`` the modelled cost of each Gaussian at typical distances."""
        return torch.where(dialled.keep, self.fixed + self._blocks(dialled, log_scales), 0)

    def _blocks(self, dialled: Attenuated, log_scales: Tensor) -> Tensor:
        size = (2 / 3) * (log_scales.sum(1) - self.log_scales)
        return self.blocks * dialled.growth.square() * size.exp() * (_reach(dialled.drawn) / self.reach)

    def gradients(
        self, parameters: dict[str, Tensor], typical: Tensor, s: float, loss: Number, attenuation: AttenuationConfig,
        config: AdaptConfig,
    ) -> dict[str, Tensor]:  # fmt: skip
        """The term's gradients at the dial value s, by parameter.

        Those of ``loss reg_weight (c / target - 1)^2``, c the corrected share of the cost, as in
        ``target_count.count_gradient``: of log sigma_d through the cull, by ``count_slope`` times what a Gaussian costs
        there, and of whatever changes the areas of those that are drawn. That of the opacity is ``-HIDING`` times the
        one of its own area.

        Args:
            parameters: ``[N, ...]``, with ``log_sigma``.
            typical: ``[N]`` normalised distances.
            loss: the weighted loss, a constant.
        """
        names = [name for name in CHANGING if name in parameters]
        leaves = {name: parameters[name].detach().requires_grad_() for name in names}
        logits, scales = leaves["opacity_logits"], leaves["log_scales"]
        sigma, growth_d = leaves["log_sigma"].exp(), leaves.get("growth_d")
        dialled = attenuate(logits, sigma, typical, s, attenuation, growth_d=growth_d)
        cost = self.modelled(dialled, scales).sum() / self.total
        found = dict(zip(names, torch.autograd.grad(cost, list(leaves.values())), strict=True))
        found["opacity_logits"] = found["opacity_logits"] * -HIDING
        target = target_curve(s, float(self.measured[1]), EXPONENT)
        penalty = 2 * loss * config.reg_weight * (cost.detach().double() * self.factor(s) / target - 1) / target
        found["log_sigma"] = found["log_sigma"] + self._cull(
            dialled, logits, scales, s, attenuation, config, penalty < 0
        )
        return {name: penalty * value for name, value in found.items()}

    @torch.no_grad()
    def _cull(
        self, dialled: Attenuated, logits: Tensor, log_scales: Tensor, s: float, attenuation: AttenuationConfig,
        config: AdaptConfig, lift: bool | Tensor,
    ) -> Tensor:  # fmt: skip
        """``[N]`` the soft derivative of the share of the cost by log sigma_d, through the cull."""
        slope = len(logits) * lifted_slope(dialled, logits, s, attenuation.tau, config.temperature, lift)
        fading = torch.full_like(logits, FADING * culling_threshold(attenuation.tau, s))
        there = self.fixed + self._blocks(dialled._replace(drawn=fading), log_scales)
        return slope * there / self.total


def _reach(opacities: Tensor) -> Tensor:
    """``log(a / ALPHA_MIN)``, at least 0: twice the squared radius of the ellipse, in standard deviations."""
    return (opacities.clamp(min=float(ALPHA_MIN)) / float(ALPHA_MIN)).log()
