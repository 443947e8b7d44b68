"""The dial's equation, in stable form: what distance does to opacity, and when a Gaussian leaves.

Source: "CLoD-GS: Continuous Level-of-Detail via 3D Gaussian Splatting", ICLR 2026: the attenuated opacity
is its Eq. 2 (section 3.2), the cut is the mask M_i of the same section. For activated opacity ``a``, decay
``sigma``, normalised distance ``d`` and dial ``s`` (the paper's virtual distance scale)::

    v   = relu(sigma)^2 + eps/2                     the variance of the decay
    a'' = a exp(-(d s)^2 / (2 v))                   attenuated opacity
    kept iff a'' > tau s                            compared as logarithms, which do not underflow

A kept Gaussian is drawn with opacity a'' under the paper's cut, named ``hard``: it leaves with opacity
``tau s``, which pops. Under the cut named ``soft`` it is drawn with ``a'' min(1, 2 (a'' / (tau s) - 1))``: nothing
changes above 1.5 tau s, and from there it fades to 0 where it leaves. The same Gaussians are kept, and the picture is
continuous in dial and camera: per unit of ``log s`` or ``log d`` what is drawn changes by at most 4.3, namely by
``2 x (1.5 - 4 log x)`` with ``x = min(1.5 tau s, e^(-5/8))`` or, where that is less, by 2/e.

Throughout: tensors are ``[N]``, one entry per Gaussian, on one device. ``opacity_logits`` may be +-inf,
``sigma_d`` and the distances are finite, distances are >= 0; in float64, which has no wider type to square them in,
neither they nor d s exceed 1e150. Half-precision inputs are computed, and their results returned, in float32;
otherwise the result has the inputs' common dtype.

Accuracy, measured against mpmath (benchmarks/stability_equation.py), in relative errors: log a'' and its gradients are
within ``4 finfo.eps``, and so are, from float32, a'' and its gradients where a'' is a normal number; from float64 these
are within ``4 + 3 u`` of them, ``u = (d s)^2 / (2 v)``.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from clod_adapter._support.fusing import Fused, Number
from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig, require
from clod_adapter.errors import ClodError

SIGMA_MAX = 1e9
"""Stands for an infinite sigma_d. The factor is exactly 1 for d s < 2e5 in float32, d s < 10 in float64."""


class Attenuated(NamedTuple):
    """What a dial value makes of the opacities.

    Attributes:
        opacities: ``[N]`` a'', in [0, 1].
        log_opacities: ``[N]`` log a'', in [-inf, 0]; meaningful where a'' underflows.
        keep: ``[N]`` bool, ``log a'' > log(tau s)``.
        drawn: ``[N]`` what a rasterizer is given, in [0, 1]: a'' after the cut, above 0 for those kept and for no
            others.
    """

    opacities: Tensor
    log_opacities: Tensor
    keep: Tensor
    drawn: Tensor


@torch.no_grad()
def normalized_distances(means: Tensor, camera: Camera, config: AttenuationConfig) -> Tensor:
    """``[N]`` the equation's d: ``|mu - c| / D``, without unit, >= 0, in float32 or, from float64, in float64.

    D is ``normalizing_distance``. A constant for autograd: no gradient reaches ``means``, whose light
    update during training is left to the picture. ``torch.autocast`` changes nothing here.

    Args:
        means: ``[N, 3]`` world units.
    """
    means = means.to(torch.promote_types(means.dtype, torch.float32))  # float16's square overflows from 256 on
    with torch.autocast(means.device.type, enabled=False):  # it would round the camera's place to 3 digits
        distances = _distances(means, camera.position.to(means))
        return distances.div_(normalizing_distance(distances, means, camera, config))


def _distances(means: Tensor, position: Tensor) -> Tensor:
    x, y, z = (means - position).unbind(1)  # three times as fast as a norm over rows of 3
    return x.square().addcmul_(y, y).addcmul_(z, z).sqrt_()


@torch.no_grad()
def normalizing_distance(distances: Tensor, means: Tensor, camera: Camera, config: AttenuationConfig) -> Tensor:
    """0-d, the D that distances are divided by, world units, > 0; ``config.normalizer`` says which.

    ``scene`` is ``config.scene_distance``. ``max`` (the paper's) and ``quantile`` look at the Gaussians
    whose centre projects into the image from beyond the near plane, or at all of them where
    there is none; the quantile is an element, the ``ceil(q n)``-th smallest, not an interpolation. Never
    below the smallest normal number, so that 0 / D is 0; 1 where there are no Gaussians at all.

    Args:
        distances: ``[N]`` from the camera's centre, world units.
        means: ``[N, 3]`` world units.
    """
    if config.normalizer == "scene" or len(distances) == 0:
        value = config.scene_distance if config.normalizer == "scene" else 1.0
        return torch.full((), value, dtype=distances.dtype, device=distances.device)
    visible = distances[in_frustum(means, camera)]
    if len(visible) == 0:
        visible = distances
    if config.normalizer == "max":
        found = visible.max()
    else:
        # Not torch.quantile: it sorts, and refuses more than 16M elements.
        found = visible.kthvalue(min(max(math.ceil(config.quantile * len(visible)), 1), len(visible))).values
    return found.clamp(min=torch.finfo(found.dtype).tiny)


def in_frustum(means: Tensor, camera: Camera) -> Tensor:
    """``[N]`` bool: the centre projects into the image, from beyond the near plane."""
    projection = (camera.K @ camera.viewmat[:3].to(camera.K)).to(means)
    x, y, z = projection[:, :3] @ means.T + projection[:, 3:]
    return (z > camera.near) & (x >= 0) & (x < camera.width * z) & (y >= 0) & (y < camera.height * z)


def log_attenuation(sigma_d: Tensor, d: Tensor, virtual_scale: float, eps: float) -> Tensor:
    """``[N]`` log of the attenuation factor, ``-(d s)^2 / (2 relu(sigma)^2 + eps)``, in [-inf, 0].

    Differentiable in ``sigma_d`` only, once: with ``u = (d s)^2 / (2 v)`` the slope is
    ``2 u relu(sigma) / v``. ``d = 0`` gives 0 whatever sigma is; ``sigma <= 0`` with ``eps = 0`` and d > 0
    gives -inf. A slope that overflows counts as 0: nothing is left there that it could move. Never NaN.

    Args:
        virtual_scale: the dial s, >= 1.
        eps: the paper's epsilon, >= 0.

    Raises:
        ClodError: the dial is below 1 or not finite, or the shapes differ.
    """
    check_dial(virtual_scale)
    sigma_d, d = conform(sigma_d=sigma_d, d=d)
    opaque = torch.full_like(sigma_d, math.inf)  # log a'' of a Gaussian with log a = 0
    return _Attenuate.apply(opaque, sigma_d, d.detach(), float(virtual_scale), eps)[1]


def attenuate(
    opacity_logits: Tensor, sigma_d: Tensor, d: Tensor, virtual_scale: float, config: AttenuationConfig
) -> Attenuated:
    """The opacities at one dial value, and which Gaussians stay.

    ``a'' = sigmoid(logit) exp(log_attenuation)``, then the cut, and ``log a'' = logsigmoid(logit) +
    log_attenuation``, both differentiable, once, in ``opacity_logits`` and ``sigma_d``. Where the factor is
    exactly 1, a'' is ``sigmoid(logit)`` bit for bit: under the hard cut a dial that does nothing changes only
    what is fainter than tau. At a logit of +inf the opacity is 1 and its gradient 0. Kept sets are nested:
    what is kept at s is kept at every smaller dial.

    Args:
        d: ``[N]`` from ``normalized_distances``.
        virtual_scale: the dial s, >= 1.

    Raises:
        ClodError: the dial is below 1 or not finite, or the shapes differ.
    """
    check_dial(virtual_scale)
    tensors = conform(opacity_logits=opacity_logits, sigma_d=sigma_d, d=d.detach())
    numbers = float(virtual_scale), log_threshold(config.tau, virtual_scale)
    return Attenuated(*_attenuated(*tensors, *numbers, eps=config.eps, cut=config.cut))


def attenuate_seen(
    means: Tensor, opacity_logits: Tensor, sigma_d: Tensor, camera: Camera, virtual_scale: float,
    config: AttenuationConfig,
) -> Attenuated:  # fmt: skip
    """``attenuate`` of ``normalized_distances``.

    On a GPU, of many Gaussians, compiled to one pass (``fusing``): of a float32 Gaussian it reads 20 bytes (centre,
    logit, sigma) and writes the 13 of the results. The plain passes move 340 to 370.

    Raises:
        ClodError: the dial is below 1 or not finite, or the shapes differ.
    """
    if not _seen.compiles(means):
        distances = normalized_distances(means, camera, config)
        return attenuate(opacity_logits, sigma_d, distances, virtual_scale, config)
    check_dial(virtual_scale)
    with torch.no_grad(), torch.autocast(means.device.type, enabled=False):
        means = means.detach().to(torch.promote_types(means.dtype, torch.float32))
        position = camera.position.to(means)
        unit: Number = config.scene_distance
        if config.normalizer != "scene":
            unit = normalizing_distance(_distances(means, position), means, camera, config)
    logits, sigma, _ = conform(opacity_logits=opacity_logits, sigma_d=sigma_d, x=means[:, 0])
    numbers = float(virtual_scale), log_threshold(config.tau, virtual_scale)
    return Attenuated(*_seen(means, position, unit, logits, sigma, *numbers, eps=config.eps, cut=config.cut))


def attenuate_activated(
    opacities: Tensor, sigma_d: Tensor, d: Tensor, virtual_scale: float, config: AttenuationConfig
) -> Attenuated:
    """The same from activated ``opacities [N]``, in [0, 1], as rasterizers are given them.

    ``a'' = a exp(log_attenuation)``, differentiable, once, in ``opacities`` and ``sigma_d``. The slope by the opacity
    is finite throughout: at 1 it is the factor's and the cut's, as anywhere, and at 0 that of a'' is the factor while
    those of ``log_opacities`` (-inf) and ``drawn`` count as 0.

    Raises:
        ClodError: the dial is below 1 or not finite, or the shapes differ.
    """
    check_dial(virtual_scale)
    tensors = conform(opacities=opacities, sigma_d=sigma_d, d=d.detach())
    numbers = float(virtual_scale), log_threshold(config.tau, virtual_scale)
    return Attenuated(*_activated(*tensors, *numbers, eps=config.eps, cut=config.cut))


Fields = tuple[Tensor, Tensor, Tensor, Tensor]


def _from_logits(
    logits: Tensor, sigma: Tensor, d: Tensor, virtual_scale: Number, threshold: Number, *, eps: float, cut: str
) -> Fields:
    opacities, log_opacities = _Attenuate.apply(logits, sigma, d, virtual_scale, eps)
    return _cut(opacities, log_opacities, threshold, cut)


def _from_centres(
    means: Tensor, position: Tensor, unit: Number, logits: Tensor, sigma: Tensor, virtual_scale: Number,
    threshold: Number, *, eps: float, cut: str,
) -> Fields:  # fmt: skip
    d = _distances(means, position).div_(unit)
    return _from_logits(logits, sigma, d, virtual_scale, threshold, eps=eps, cut=cut)


def _from_opacities(
    opacities: Tensor, sigma: Tensor, d: Tensor, virtual_scale: Number, threshold: Number, *, eps: float, cut: str
) -> Fields:
    opaque = torch.full_like(opacities, math.inf)
    factor, log_factor = _Attenuate.apply(opaque, sigma, d, virtual_scale, eps)
    nothing = opacities <= 0
    logs = opacities.masked_fill(nothing, 1).log().masked_fill(nothing, -math.inf)  # no slope, rather than 1 / 0
    return _cut(opacities * factor, logs + log_factor, threshold, cut)


_attenuated, _seen, _activated = Fused(_from_logits), Fused(_from_centres), Fused(_from_opacities)


def _cut(opacities: Tensor, log_opacities: Tensor, threshold: Number, cut: str) -> Fields:
    """The fields of ``Attenuated``: the faded opacities, who stays of them, and what is drawn."""
    keep = log_opacities.detach() > threshold
    # The hard cut's product is five times as fast as where.
    drawn = opacities * keep.to(opacities) if cut == "hard" else _Fade.apply(opacities, log_opacities, threshold)
    return opacities, log_opacities, keep, drawn


class _Attenuate(Function):
    """``(sigmoid(l) e^-u, logsigmoid(l) - u)`` for logit l and ``u = (d s)^2 / (2 v)``; with w = g1 a'' + g2, the
    gradient is ``w sigmoid(-l)`` for l and ``2 u relu(sigma) / v w`` for sigma.

    u is float64's until it is rounded: float32's exponential would multiply its rounding by u.
    """

    @staticmethod
    def forward(ctx: Any, logits: Tensor, sigma: Tensor, d: Tensor, virtual_scale: Number, eps: float) -> Any:
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


class _Fade(Function):
    """``a'' f`` with ``f = min(1, 2 (e^x - 1))`` and ``x = log a'' - log(tau s)``, 0 where x <= 0.

    From the same difference as ``keep``, so that who is kept is drawn. f's slope by x is ``f + 2`` where it has one.
    """

    @staticmethod
    def forward(ctx: Any, opacities: Tensor, log_opacities: Tensor, threshold: Number) -> Tensor:
        share = (log_opacities - threshold).clamp_(max=1).expm1_().mul_(2).clamp_(0, 1)
        ctx.save_for_backward(opacities, share)
        return opacities * share

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        opacities, share = ctx.saved_tensors
        fading = share.ceil() - share.floor()  # 1 strictly between 0 and 1; several times as fast as comparing
        return grad * share, fading.mul_(share + 2).mul_(opacities).mul_(grad), None


def check_dial(virtual_scale: float) -> None:
    """Raises ClodError for a dial below 1 or not finite."""
    require(1 <= virtual_scale < math.inf, "virtual_scale", virtual_scale, "at least 1 and finite")


def twice_variance(sigma: Tensor, eps: float) -> Tensor:
    """``2 v = 2 relu(sigma)^2 + eps`` in float64, where squares of float32's numbers neither underflow nor overflow."""
    return sigma.relu().double().square_().mul_(2).add_(eps)


def log_threshold(tau: float, virtual_scale: float) -> float:
    """``log(tau s)``, what log a'' must exceed."""
    return math.log(tau * virtual_scale)


def conform(**tensors: Tensor) -> list[Tensor]:
    """The tensors in their common dtype, at least float32; raises ClodError unless they share one [N]."""
    shapes = {name: tuple(t.shape) for name, t in tensors.items()}
    if len(set(shapes.values())) != 1 or any(len(shape) != 1 for shape in shapes.values()):
        raise ClodError("expected one shape [N], got " + ", ".join(f"{name} {shape}" for name, shape in shapes.items()))
    dtype = reduce(torch.promote_types, (t.dtype for t in tensors.values()), torch.float32)
    return [t.to(dtype) for t in tensors.values()]
