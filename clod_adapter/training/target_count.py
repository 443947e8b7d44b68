"""The target-count curve: the share of Gaussians to keep at each dial value, and the loss term that enforces it."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.equation.attenuation import attenuate, conform, log_threshold

TEMPERATURE = 0.15  # width of the sigmoid of the soft count, in log opacity
# Lower bound of the sigmoid's slope, which is at most 1/4, for culled Gaussians while too few are kept. Some widths
# below the culling threshold it is exactly 0, and so is the image's gradient: no step would bring such a sigma back.
LIFT = 1e-3
Number = float | Tensor


class TargetShare(NamedTuple):
    """The share > 0 of some Gaussians to keep at one dial value, and the weight of a relative deviation from it.

    The weight is ``1 / share`` where these are all Gaussians of the scene.
    """

    share: float
    weight: float


def target_curve(virtual_scale: float, share: float, exponent: float) -> float:
    """The share of all Gaussians to keep at a dial value s: ``1 / (s^p + (1/share - 1) s^-p)``.

    ``share`` at s = 1, and close to the paper's target ``s^-p`` (section 3.3, p = 1.5) for larger s: with a share of
    0.62, 7 % below it at s = 2 and 2 % at s = 3. 1 below s = 1.
    """
    if virtual_scale < 1:
        return 1.0
    power = virtual_scale**exponent
    return 1 / (power + (1 / share - 1) / power)


def target_share(virtual_scale: float, count: int, config: AdaptConfig, total: int | None = None) -> TargetShare:
    """The target of ``count`` of ``total`` Gaussians (all if None): ``target_curve``, but at least one Gaussian."""
    total = total or max(count, 1)
    share = max(target_curve(virtual_scale, config.share, config.exponent), 1 / total) * (total / max(count, 1))
    return TargetShare(share, 1 / share)


def count_gradient(
    distances: Tensor, opacity_logits: Tensor, sigma_d: Tensor, virtual_scale: float, attenuation: AttenuationConfig,
    loss: Number, config: AdaptConfig, target: TargetShare,
) -> Tensor:  # fmt: skip
    """``[N]`` the count term's gradient of log sigma_d at one dial value; opacities are constants.

    The gradient of ``loss reg_weight (eta / target - 1)^2``, eta the share kept, through ``count_slope``. It is
    relative to the target, as the last percent of the Gaussians matters as much as the first, and to the weighted
    ``loss``, a constant here, so that one setting suits scenes and dial values that are fitted well or badly. Where too
    few are kept, culled Gaussians are brought back: with a slope of at least ``LIFT / (temperature N)``.
    """
    given = opacity_logits, sigma_d, distances
    if any(x.device.type != "cpu" or x.dtype != torch.float32 for x in given):
        dialled = attenuate(*given, virtual_scale, attenuation)
        eta = dialled.keep.sum().double() / len(opacity_logits)  # a tensor: a float would wait for a GPU
        penalty = _penalty(eta, target, loss, config)
        slope = count_slope(opacity_logits, dialled.log_opacities, virtual_scale, attenuation.tau, TEMPERATURE)
        least = (torch.as_tensor(penalty < 0) & ~dialled.keep) * (LIFT / (TEMPERATURE * len(slope)))
        return slope.clamp_(min=least).mul_(penalty)
    # The same in two compiled passes.
    from clod_adapter._kernels import count, threads
    from clod_adapter.rasterizers.cpu import dial_vector, workers_for

    out = torch.empty_like(opacity_logits, memory_format=torch.contiguous_format)
    n, workers = len(out), workers_for(len(out))
    arrays = [x.detach().contiguous().numpy() for x in given]
    dial, counts = dial_vector(attenuation, virtual_scale), np.zeros(workers, np.int64)
    threads.run(count.count_kept, workers, *arrays, dial, counts)
    penalty = float(_penalty(float(counts.sum()) / n, target, loss, config))
    scale = TEMPERATURE, LIFT if penalty < 0 else 0.0, penalty / (TEMPERATURE * n)
    threads.run(count.count_slope, workers, *arrays, dial, *scale, out.numpy())
    return out


def _penalty(eta: Number, target: TargetShare, loss: Number, config: AdaptConfig) -> Number:
    """The derivative of ``loss reg_weight (eta / target - 1)^2`` by the share eta."""
    return 2 * loss * config.reg_weight * (eta / target.share - 1) * target.weight


@torch.no_grad()
def count_slope(
    opacity_logits: Tensor, log_opacities: Tensor, virtual_scale: float, tau: float, temperature: float
) -> Tensor:
    """``[N]`` the softened derivative of the share kept by each Gaussian's ``log sigma_d``.

    ``q (1 - q) / (temperature N) max(2 u, 1)`` with ``q = sigmoid((log a'' - log(tau s)) / temperature)`` and
    ``u = log a - log a''``: the slope of a soft count by ``log sigma_d``, except that its factor ``2 u`` is
    at least 1: Gaussians that are not attenuated yet have u = 0 and would never be. 0 at log a'' = -inf.
    """
    opacity_logits, log_opacities = conform(opacity_logits=opacity_logits, log_opacities=log_opacities)
    factor = (F.logsigmoid(opacity_logits) - log_opacities).mul_(2).clamp_(min=1)
    slope = slope_of_sigmoid(log_opacities, log_threshold(tau, virtual_scale), temperature)
    # Where log a'' is -inf the slope is 0 and the factor inf.
    return slope.mul_(factor).nan_to_num_(0.0, 0.0)


def slope_of_sigmoid(log_opacities: Tensor, threshold: float, temperature: float) -> Tensor:
    """``[N]`` the slope of the mean of ``sigmoid(z)``, ``z = (log a'' - threshold) / temperature``, by log a''.

    ``sigmoid(z) sigmoid(-z) / (temperature N)``, as 1 - sigmoid(z) would cancel. The temperature is clamped
    to normal numbers of the dtype: neither 0 / 0 nor inf / inf.
    """
    info = torch.finfo(log_opacities.dtype)
    temperature = min(max(temperature, info.tiny), info.max)
    z = (log_opacities - threshold).div_(temperature)
    return z.sigmoid().mul_(z.neg_().sigmoid_()).div_(temperature * max(len(z), 1))
