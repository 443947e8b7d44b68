"""The dial value s* at which a Gaussian is culled, in closed form, and its inverse; symbols of ``attenuation.py``."""

import torch
import torch.nn.functional as F
from torch import Tensor

from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import SIGMA_MAX, conform, culling_threshold, log_threshold
from clod_adapter.equation.autograd import twice_variance

_LOG_HUGE = 1e4  # above the logarithms that float64 products here can have


@torch.no_grad()
def extinction_scale(opacity_logits: Tensor, sigma_d: Tensor, d: Tensor, config: AttenuationConfig) -> Tensor:
    """``[N]`` the dial value s* at which each Gaussian is culled: kept at s iff ``s < s*`` (up to rounding).

    The unique root of ``a exp(-(d s)^2 / (2 v)) = tau s``, which is
    ``s*^2 = (v / d^2) W(a^2 d^2 / (tau^2 v))`` with W the principal Lambert function. In [0, a/tau]; below
    1 the Gaussian is kept at no dial value. ``a/tau`` where d = 0 (or d^2 / v is negligible); 0 where sigma <= 0,
    eps = 0 and d > 0. Below ``s = FAINTEST / tau``, where the threshold no longer falls, more are culled. No gradient.

    Accuracy: relative error within ``(6 + |log a|) * finfo.eps`` where ``a`` is a normal number. Logarithms that are
    off by a unit in the last place, as on some processors, add ``|log tau|``.
    """
    opacity_logits, sigma_d, d = conform(opacity_logits=opacity_logits, sigma_d=sigma_d, d=d)
    radius = twice_variance(sigma_d, config.eps).div_(2).sqrt_()
    ratio = (d.double() / radius).to(d.dtype).masked_fill_(d == 0, 0)
    upper = opacity_logits.sigmoid().div_(culling_threshold(config.tau, 1.0))
    log_ratio = ratio.log().clamp_(max=_LOG_HUGE)  # ratio is inf where the variance is 0
    w = _lambert_w_of_exp((F.logsigmoid(opacity_logits) - log_threshold(config.tau, 1.0) + log_ratio).mul_(2))
    # The same value twice: e^{-W/2} = sqrt(W / z). The first is accurate at small W, the second at large W.
    return torch.where(w < 1, upper * torch.exp(-0.5 * w), w.sqrt().div_(ratio))


@torch.no_grad()
def sigma_for_extinction(opacity_logits: Tensor, d: Tensor, extinction: Tensor, config: AttenuationConfig) -> Tensor:
    """``[N]`` the sigma_d with which a Gaussian at distance d is culled at s*; inverse of ``extinction_scale``.

    ``v = (d s*)^2 / (2 log(a / (tau s*)))``, ``sigma = sqrt(max(v - eps/2, 0))``, in [0, SIGMA_MAX].
    ``SIGMA_MAX`` where ``s* >= a/tau``, which no finite sigma reaches. 0 where s* is below what eps alone
    allows, and at d = 0, where sigma has no effect. No gradient.

    Computed in float64. Accuracy: sigma^2 is off by at most ``4 finfo.eps``, and ``(|log a| + |log(tau s*)| + 1) /
    log(a / (tau s*))`` of float64's eps, times the larger of v and eps/2: the last step before ``a/tau`` is steep.
    """
    given = conform(opacity_logits=opacity_logits, d=d, extinction=extinction)
    opacity_logits, d, extinction = (t.double() for t in given)
    drop = F.logsigmoid(opacity_logits) - culling_threshold(config.tau, extinction).log_()
    variance = (d * extinction).square_().div_(2 * drop)
    sigma = variance.sub_(config.eps / 2).clamp_(min=0).sqrt_()
    return torch.where(drop > 0, sigma, SIGMA_MAX).clamp_(max=SIGMA_MAX).to(given[0].dtype)


def _lambert_w_of_exp(x: Tensor) -> Tensor:
    """W(e^x): the w > 0 with ``w + log w = x``, to rounding; x is clamped to [-80, 1e4].

    Two steps of Fritsch, Shafer and Crowley (CACM 16(2), 1973, Algorithm 443), each of fourth order.
    """
    x = x.clamp(-80, _LOG_HUGE)  # e^-80 is nothing beside 1
    w = torch.where(x > 1, x - x.clamp(min=1).log_(), x.sigmoid())
    for _ in range(2):
        r = x - w.log() - w
        q = 2 * (1 + w) * (1 + w + r * (2 / 3))
        w = w * (1 + r / (1 + w) * ((q - r) / (q - 2 * r)))
    return w
