"""The count law: how many Gaussians to keep at each dial value, and what holds training to it."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from clod_adapter.attenuation import Attenuated, count_slope, extinction_scale
from clod_adapter.config import AdaptConfig, AttenuationConfig

NODES = 13  # of the measured counts, evenly spaced in log s from 1 to max_sv
MEMORY = 0.9  # of the running mean of what is measured at a node
EVERY = 25  # steps between two corrections
SHARE = 0.3  # of what is found wrong that a correction mends


def count_law(virtual_scale: float, share: float, exponent: float) -> float:
    """The share of all Gaussians to keep at a dial value s: ``1 / (s^p + (1/share - 1) s^-p)``.

    ``share`` at s = 1, and soon the paper's target ``s^-p`` (section 3.3, p = 1.5): with a share of 0.62, 7 % below it
    at s = 2 and 2 % at s = 3.
    """
    power = virtual_scale**exponent
    return 1 / (power + (1 / share - 1) / power)


class CountLaw:
    """Holds the share kept, eta(s), to ``count_law(s)`` while sigma_d is trained, in two parts.

    A *price* decides who stays: each step adds ``reg_weight / law(s) d eta / d log sigma_d`` to the gradient of log
    sigma_d (``attenuation.count_slope``). Who is worth less to the picture than the price fades sooner, who is worth
    more later. A *correction* decides how many: every EVERY steps the running mean of ``log(eta / law)`` over log s
    is turned into a shift of log sigma_d, the same for all that leave at about the same s, so that nobody overtakes
    anybody: ``-log(eta / law) / exponent`` at a Gaussian's extinction scale, which moves that scale by as much.
    Either alone does worse (docs/method.md): a price that has to hold the counts must be high where the picture needs
    the Gaussians most, and corrections without a price keep whoever is there.

    Args:
        distances: ``[N]`` normalised distance at which a Gaussian's extinction scale is taken.
    """

    def __init__(self, config: AdaptConfig, attenuation: AttenuationConfig, distances: Tensor) -> None:
        self.config, self.attenuation, self.distances = config, attenuation, distances
        self.excess = np.zeros(NODES)  # running means of log(eta / law)
        self.steps = 0

    def gradient(self, dialled: Attenuated, opacity_logits: Tensor, virtual_scale: float) -> Tensor:
        """``[N]`` by log sigma_d, of the price at one dial value, opacities held; takes note of the count."""
        law = count_law(virtual_scale, self.config.start_share, self.config.exponent)
        eta = float(dialled.keep.sum()) / len(opacity_logits)
        at = (NODES - 1) * math.log(virtual_scale) / math.log(self.config.max_sv)
        left = min(int(at), NODES - 2)
        for node, weight in ((left, left + 1 - at), (left + 1, at - left)):
            self.excess[node] += (1 - MEMORY) * weight * (math.log(max(eta / law, 1e-3)) - self.excess[node])
        slope = count_slope(
            opacity_logits, dialled.log_opacities.detach(), virtual_scale, self.attenuation.tau, self.config.temperature
        )
        return slope.mul_(self.config.reg_weight / law)

    def correction(self, opacity_logits: Tensor, sigma_d: Tensor) -> Tensor | None:
        """``[N]`` what to add to log sigma_d after this step, None for nothing."""
        self.steps += 1
        if self.steps % EVERY:
            return None
        leaves = extinction_scale(opacity_logits, sigma_d, self.distances, self.attenuation)
        nodes = np.linspace(0, math.log(self.config.max_sv), NODES)
        shift = np.interp(leaves.clamp(min=1e-3).log().numpy(force=True), nodes, self.excess * SHARE)
        self.excess *= 1 - SHARE
        return torch.from_numpy(-shift / self.config.exponent).to(sigma_d)
