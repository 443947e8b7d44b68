"""The differentiable functions of the dial's equation (``attenuation.py``): attenuation, and the soft cut."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable


def twice_variance(sigma: Tensor, eps: float) -> Tensor:
    """``2 v = 2 relu(sigma)^2 + eps`` in float64, where squares of float32's numbers neither underflow nor overflow."""
    return sigma.relu().double().square_().mul_(2).add_(eps)


class Attenuate(Function):
    """``(sigmoid(l) e^-u, logsigmoid(l) - u)`` for logit l and ``u = (d s)^2 / (2 v)``; with w = g1 a'' + g2, the
    gradient is ``w sigmoid(-l)`` for l and ``2 u relu(sigma) / v w`` for sigma.

    u is float64's until it is rounded: float32's exponential would multiply its rounding by u.
    """

    @staticmethod
    def forward(ctx: Any, logits: Tensor, sigma: Tensor, d: Tensor, virtual_scale: float, eps: float) -> Any:
        dtype, variance = logits.dtype, twice_variance(sigma, eps)
        u = d.double().mul(virtual_scale).square_().div_(variance)
        if eps == 0:  # then the variance may be 0, and 0/0 is to be 0
            u.masked_fill_(d == 0, 0)
        factor = u.neg().exp_()
        if dtype == torch.float64:  # some processors' exp gives 1 - 2^-53 here; float32's rounding gives 1
            factor.masked_fill_(u < 2**-54, 1)
        opacities = factor.to(dtype).mul_(logits.sigmoid())
        ctx.save_for_backward(logits, sigma, variance, u, opacities)
        ctx.set_materialize_grads(False)
        return opacities, F.logsigmoid(logits).sub_(u.to(dtype))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor | None, grad_log: Tensor | None) -> Any:
        logits, sigma, variance, u, opacities = ctx.saved_tensors
        if grad is None:
            total = grad_log
        else:
            total = grad * opacities if grad_log is None else torch.addcmul(grad_log, grad, opacities)
        by_logit = by_sigma = None
        if total is not None and ctx.needs_input_grad[0]:
            by_logit = logits.neg().sigmoid_().mul_(total)
        if total is not None and ctx.needs_input_grad[1]:
            slope = sigma.relu().double().div_(variance).mul_(u).mul_(4).to(sigma.dtype)
            by_sigma = slope.nan_to_num_(0.0, 0.0, 0.0).mul_(total)
        return by_logit, by_sigma, None, None, None


class Fade(Function):
    """``a'' f`` with ``f = min(1, 2 (e^x - 1))`` and ``x = log a'' - log(tau s)``, 0 where x <= 0.

    Uses the same difference as ``keep``, so that exactly the kept Gaussians are drawn. f's slope by x is ``f + 2``.
    """

    @staticmethod
    def forward(ctx: Any, opacities: Tensor, log_opacities: Tensor, threshold: float) -> Tensor:
        share = (log_opacities - threshold).clamp_(max=1).expm1_().mul_(2).clamp_(0, 1)
        ctx.save_for_backward(opacities, share)
        return opacities * share

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        opacities, share = ctx.saved_tensors
        fading = share.ceil() - share.floor()  # 1 strictly between 0 and 1; several times as fast as comparing
        return grad * share, fading.mul_(share + 2).mul_(opacities).mul_(grad), None
