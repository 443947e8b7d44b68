"""The target-count curve: the share of Gaussians to keep at each dial value, and the loss term that
enforces it.
"""

import torch
from torch import Tensor

from clod_adapter.config import AdaptConfig

DOUBLINGS = 5
SHARPNESS = 2**DOUBLINGS  # of the soft count: the exponent of t
# Lower bound of w / (1 + w)^2, which is at most 1/4, for culled Gaussians while too few are kept.
# Far beyond its reach a Gaussian's is 0, and so is the image's gradient: no step would bring such a
# sigma back.
LIFT = 1e-3
Number = float | Tensor


def target_curve(virtual_scale: float, share: float, exponent: float) -> float:
    """The share of all Gaussians to keep at a dial value s: ``1 / (s^p + (1/share - 1) s^-p)``.

    ``share`` at s = 1, and close to the paper's target ``s^-p`` (section 3.3, p = 1.5) for larger
    s: with a share of 0.62, 7 % below it at s = 2 and 2 % at s = 3. 1 below s = 1.
    """
    if virtual_scale < 1:
        return 1.0
    power = virtual_scale**exponent
    return 1 / (power + (1 / share - 1) / power)


def target_share(
    virtual_scale: float,
    count: int,
    config: AdaptConfig,
    total: int | None = None,
) -> float:
    """The share to keep of ``count`` of ``total`` Gaussians (all if None): ``target_curve``, but at
    least one.
    """
    total = total or max(count, 1)
    share = max(target_curve(virtual_scale, config.start_share, config.exponent), 1 / total)
    return min(share * (total / max(count, 1)), 1.0)


@torch.no_grad()
def count_gradient(
    distances: Tensor,
    sigma_d: Tensor,
    virtual_scale: float,
    loss: Number,
    config: AdaptConfig,
    target: float,
) -> Tensor:
    """``[N]`` the count term's gradient of log sigma_d at one dial value.

    The gradient of ``loss reg_weight (eta / target - 1)^2``, eta the share kept, through
    ``count_slope``. It is relative to the target, as the last percent of the Gaussians matters as
    much as the first, and to the weighted ``loss``, a constant here, so that one setting suits
    scenes and dial values that are fitted well or badly. Where too few are kept, culled Gaussians
    are brought back: with a slope of at least ``LIFT SHARPNESS / N``.
    """
    n = len(sigma_d)
    far = distances * virtual_scale
    keep = far < sigma_d
    eta = keep.sum().double() / n  # a tensor: a float would wait for a GPU
    penalty = _penalty(eta, target, loss, config)
    slope = count_slope(far, sigma_d)
    least = (torch.as_tensor(penalty < 0) & ~keep) * (LIFT * SHARPNESS / n)
    return slope.clamp_(min=least).mul_(penalty)


def _penalty(eta: Number, target: float, loss: Number, config: AdaptConfig) -> Number:
    """The derivative of ``loss reg_weight (eta / target - 1)^2`` by the share eta."""
    return 2 * loss * config.reg_weight * (eta / target - 1) / target


def count_slope(far: Tensor, sigma_d: Tensor) -> Tensor:
    """``[N]`` the derivative of a soft count, as a share of N, by each Gaussian's ``log sigma_d``.

    ``SHARPNESS w / (1 + w)^2 / N`` with ``w = min(t, 1 / t)^SHARPNESS`` and ``t = far / sigma_d``:
    the slope of ``1 / (1 + t^SHARPNESS)``, which is 1 where a Gaussian is kept and 0 beyond. 0 at
    ``sigma_d <= 0``.
    """
    t = far / sigma_d.clamp(min=0)
    w = torch.minimum(t, 1 / t).nan_to_num_(0.0)
    for _ in range(DOUBLINGS):  # faster than pow
        w.square_()
    return w.div_((1 + w).square_()).mul_(SHARPNESS / max(len(w), 1))
