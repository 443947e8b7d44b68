"""The count law: how many Gaussians to keep at each dial value, and what presses training towards it."""

from __future__ import annotations

from torch import Tensor

from clod_adapter.attenuation import Attenuated, count_slope
from clod_adapter.config import AdaptConfig


def count_law(virtual_scale: float, share: float, exponent: float) -> float:
    """The share of all Gaussians to keep at a dial value s: ``1 / (s^p + (1/share - 1) s^-p)``.

    ``share`` at s = 1, and soon the paper's target ``s^-p`` (section 3.3, p = 1.5): with a share of 0.62, 7 % below it
    at s = 2 and 2 % at s = 3.
    """
    power = virtual_scale**exponent
    return 1 / (power + (1 / share - 1) / power)


def count_gradient(
    dialled: Attenuated, opacity_logits: Tensor, virtual_scale: float, tau: float, loss: float, config: AdaptConfig
) -> Tensor:
    """``[N]`` what the count term adds to the gradient of log sigma_d at one dial value; opacities are held.

    That of ``loss reg_weight (eta / law - 1)^2``, eta the share kept, through ``attenuation.count_slope``. Who is worth
    less to the picture than the pressure fades, who is worth more stays. It works both ways, and is relative: to the
    law, as the last percent of the Gaussians matters as much as the first, and to the weighted ``loss``, a constant
    here, so that the same settings suit scenes and dial values that are fitted well or badly. Nothing presses the last
    Gaussian out.
    """
    law = max(count_law(virtual_scale, config.start_share, config.exponent), 1 / len(opacity_logits))
    eta = float(dialled.keep.sum()) / len(opacity_logits)
    pressure = 2 * loss * config.reg_weight * (eta / law - 1) / law
    slope = count_slope(opacity_logits, dialled.log_opacities.detach(), virtual_scale, tau, config.temperature)
    return slope.mul_(pressure)
