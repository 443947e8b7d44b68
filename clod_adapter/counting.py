"""The count law: how many Gaussians to keep at each dial value, and what presses training towards it."""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from clod_adapter.attenuation import Attenuated, count_slope
from clod_adapter.config import AdaptConfig

NODES = 13  # of the price, evenly spaced in log s from 1 to max_sv


def count_law(virtual_scale: float, share: float, exponent: float) -> float:
    """The share of all Gaussians to keep at a dial value s: ``1 / (s^p + (1/share - 1) s^-p)``.

    ``share`` at s = 1, and soon the paper's target ``s^-p`` (section 3.3, p = 1.5): with a share of 0.62, 7 % below it
    at s = 2 and 2 % at s = 3.
    """
    power = virtual_scale**exponent
    return 1 / (power + (1 / share - 1) / power)


class CountPressure:
    """What a Gaussian pays for being kept: a price for each dial value, that rises while too many are.

    Minimises the picture's loss subject to ``eta(s) = count_law(s)``, eta the share kept: the gradient of
    ``reg_weight (eta / law - 1)^2 + price(s) eta / law`` is added to that of log sigma_d, through
    ``attenuation.count_slope``. The price is the multiplier of the constraint (dual ascent): after each step at s it
    grows by ``count_gain log(eta / law)`` at the nodes around s, and never falls below 0. Without it the square alone
    leaves more Gaussians than asked for wherever the picture needs them most, at the dial's far end.
    """

    def __init__(self, config: AdaptConfig, tau: float) -> None:
        self.config, self.tau, self.prices = config, tau, np.zeros(NODES)

    def gradient(self, dialled: Attenuated, opacity_logits: Tensor, virtual_scale: float) -> Tensor | float:
        """``[N]`` by log sigma_d, opacities held; moves the price. 0 where the config asks for no law."""
        config, s = self.config, virtual_scale
        if config.count_term != "relative" or config.reg_weight == 0 or config.max_sv == 1:
            return 0.0  # a range of one dial value asks for no law either
        law = count_law(s, config.start_share, config.exponent)
        ratio = float(dialled.keep.sum()) / len(opacity_logits) / law
        slope = count_slope(opacity_logits, dialled.log_opacities.detach(), s, self.tau, config.temperature)
        return slope.mul_((2 * config.reg_weight * (ratio - 1) + self._price(s, ratio)) / law)

    def _price(self, virtual_scale: float, ratio: float) -> float:
        """The price at s, linear between the nodes, after the step of its own."""
        at = (NODES - 1) * math.log(virtual_scale) / math.log(self.config.max_sv)
        left = min(int(at), NODES - 2)
        for node, weight in ((left, left + 1 - at), (left + 1, at - left)):
            raised = self.prices[node] + self.config.count_gain * weight * math.log(max(ratio, 1e-3))
            self.prices[node] = max(raised, 0.0)
        return float(np.interp(at, np.arange(NODES), self.prices))
