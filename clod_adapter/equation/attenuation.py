"""The dial's equation, and the one function that turns Gaussians, a camera and a dial value into what is drawn.

For activated opacity ``a``, decay ``sigma``, growth exponent ``h``, normalised distance ``d`` (``distances.py``) and
dial ``s`` (the paper's virtual distance scale)::

    v   = relu(sigma)^2 + eps/2                     the variance of the decay
    a'' = a exp(-(d s)^2 / (2 v))                   attenuated opacity
    kept iff a'' > tau s                            compared as logarithms, which do not underflow
    m   = max(1, d s / r)                           r: d at the median distance in the nearest training views
    g   = m^h                                       factor of the scales of what is kept, in [e^-20, e^20]

Sources: a'' is Eq. 2 (section 3.2) of "CLoD-GS: Continuous Level-of-Detail via 3D Gaussian Splatting", ICLR 2026, and
the culling rule is the mask M_i of the same section. Training and the paper have s >= 1; the equation holds from 0,
where nothing is attenuated, culled or enlarged. g is this project's, after stochastic simplification of aggregate
detail (Cook, Halstead, Planck and Ryu, SIGGRAPH 2007), where the elements that remain grow to preserve the area.
Opacity and scale change by ``d s``: moving away and turning the dial have one effect; nearer than r / s nothing grows.

With the ``hard`` cut (the paper's) a kept Gaussian is drawn with a'' and culled at opacity ``tau s``, which pops. With
the ``soft`` cut it is drawn with ``a'' min(1, 2 (a'' / (tau s) - 1))``, which is a'' above 1.5 tau s and 0 at the
threshold. The same Gaussians are kept, and the image is continuous in dial and camera: per unit of ``log s`` or
``log d`` the drawn opacity changes by at most 4.3, namely by ``2 x (1.5 - 4 log x)`` with
``x = min(1.5 tau s, e^(-5/8))`` or, where that is less, by 2/e.

Tensors are ``[N]``, one entry per Gaussian, on one device. ``opacity_logits`` may be +-inf. Where ``sigma_d`` is +inf
there is no dial and no cut: the Gaussian is kept and drawn with a. Distances are finite and >= 0; in float64, which has
no wider type to square them in, neither they nor a finite ``sigma_d`` nor d s exceed 1e150. Half-precision inputs are
computed in float32, and so are their results; otherwise the result has the inputs' common dtype.

Accuracy, measured against mpmath (benchmarks/stability_equation.py), in relative errors: log a'' and its gradients are
within ``4 finfo.eps``, and so are, from float32, a'' and its gradients where a'' is a normal number; from float64 these
are within ``4 + 3 u`` of them, ``u = (d s)^2 / (2 v)``. g is within ``4 + 2 |h| (1 + log m)`` of finfo.eps, its slope
within ``2 / log m`` more.
"""

import math
import warnings
from functools import reduce
from typing import NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig, require
from clod_adapter.equation.autograd import Attenuate, Fade
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians

SIGMA_MAX = 1e9
"""Stands for an infinite sigma_d. The factor is exactly 1 for d s < 2e5 in float32, d s < 10 in float64."""

FAINTEST = 2.0**-126
"""The smallest normal float32: at s = 0 only what is fainter is culled, which no rasterizer draws."""

# Of trained exponents. 3/4 preserves area where counts fall as s^-1.5; above 1 a Gaussian far away grows on the screen.
GROWTH_RANGE = (-1.0, 3.0)
LOG_GROWTH_MAX = 20.0  # of abs(log g)

Scale = TypeVar("Scale", float, Tensor)


class Attenuated(NamedTuple):
    """The opacities at one dial value, and the growth of the scales.

    Attributes:
        opacities: ``[N]`` a'', in [0, 1].
        log_opacities: ``[N]`` log a'', in [-inf, 0]; meaningful where a'' underflows.
        keep: ``[N]`` bool, ``log a'' > log(tau s)``.
        drawn: ``[N]`` the rasterizer's input, in [0, 1]: a'' after the cut, above 0 exactly for kept Gaussians.
        growth: ``[N]`` factor of the scales (``growth_factors``); ones without a ``growth_d``.
    """

    opacities: Tensor
    log_opacities: Tensor
    keep: Tensor
    drawn: Tensor
    growth: Tensor


def attenuate(
    opacities: Tensor, sigma_d: Tensor | None, seen_from: Tensor | tuple[Tensor, Camera], virtual_scale: float,
    config: AttenuationConfig | None, *, activated: bool = False, growth_d: Tensor | None = None,
) -> Attenuated:  # fmt: skip
    """What is drawn of Gaussians at one dial value. Rendering, training, baking and renderers' hooks all call this.

    ``a'' = a exp(-u)``, then the cut, differentiable, once, in ``opacities`` and ``sigma_d``, not in distances. Where
    the factor is 1, a'' is a bit for bit: with the hard cut a dial without effect changes only what is fainter than
    tau. A Gaussian kept at s is kept at every smaller dial. Without a ``sigma_d`` all are kept and drawn with a.

    Args:
        opacities: ``[N]`` logits. At a logit of +inf, a is 1 and its gradient 0.
        seen_from: ``[N]`` distances d (``distances.normalized_distances``), or the centres ``[N, 3]``, world units, and
            the camera. Pass distances to use them for several dial values.
        virtual_scale: the dial s, >= 0.
        activated: ``opacities`` are a itself, in [0, 1], as rasterizers take them. The gradient is finite: at a = 1
            it is that of the factor and the cut, as anywhere; at a = 0 the factor for a'', and 0 for the others.
        growth_d: ``[N]`` exponents h of the growth of the scales, finite; None for no growth.

    Raises:
        ClodError: the dial is negative or not finite, or the shapes differ.
    """
    check_dial(virtual_scale)
    virtual_scale = float(virtual_scale)  # of a numpy array
    if sigma_d is None or config is None:
        shown = opacities if activated else opacities.sigmoid()
        keep = torch.ones_like(shown, dtype=torch.bool)
        logs = opacities.log() if activated else F.logsigmoid(opacities)
        return Attenuated(shown, logs, keep, shown, torch.ones_like(shown))
    d = normalized_distances(*seen_from, config) if isinstance(seen_from, tuple) else seen_from
    named = {"opacities" if activated else "opacity_logits": opacities, "sigma_d": sigma_d, "d": d}
    opacities, sigma, d = conform(**named)
    if growth_d is None:
        growth = torch.ones_like(d)
    else:
        conform(sigma_d=sigma_d, growth_d=growth_d)
        growth = growth_factors(growth_d, d, virtual_scale, growth_distance(config))
    logits = torch.full_like(opacities, math.inf) if activated else opacities
    faded, log_opacities = Attenuate.apply(logits, sigma, d.detach(), virtual_scale, config.eps)
    if activated:
        nothing = opacities <= 0
        logs = opacities.masked_fill(nothing, 1).log().masked_fill(nothing, -math.inf)  # no slope, rather than 1 / 0
        faded, log_opacities = opacities * faded, logs + log_opacities
    threshold, undialled = log_threshold(config.tau, virtual_scale), sigma.detach() == math.inf
    keep = (log_opacities.detach() > threshold) | undialled
    if config.cut == "hard":
        drawn = faded * keep.to(faded)  # five times as fast as where
    else:
        drawn = torch.where(undialled, faded, Fade.apply(faded, log_opacities, threshold))
    return Attenuated(faded, log_opacities, keep, drawn, growth)


def dial(gaussians: Gaussians, seen_from: Camera | Tensor, virtual_scale: float) -> Attenuated:
    """``attenuate`` of Gaussians, seen from a camera, or from distances d ``[N]`` where these are known."""
    where = seen_from if isinstance(seen_from, Tensor) else (gaussians.means, seen_from)
    return attenuate(
        gaussians.opacity_logits, gaussians.sigma_d, where, virtual_scale, gaussians.attenuation,
        growth_d=gaussians.growth_d,
    )  # fmt: skip


def growth_distance(config: AttenuationConfig) -> float:
    """r: ``reference_distance`` in units of ``scene_distance``; 1 if it is unknown, or for other normalizers."""
    if config.normalizer != "scene" or config.reference_distance == 0:
        return 1.0
    return config.reference_distance / config.scene_distance


def growth_factors(growth_d: Tensor, d: Tensor, virtual_scale: float | Tensor, reach: float) -> Tensor:
    """``[N]`` the factors g of the scales; exactly 1 where ``growth_d`` is 0 or ``d s <= r``.

    Differentiable in ``growth_d [N]``, the finite exponents h: the slope is ``g log m``, and 0 where g is clamped.
    Never NaN. The result has the dtype of ``d [N]``, float32 or float64. ``reach`` is r.
    """
    # d s is float64's: a dial beyond float32 times a distance of 0 would be NaN.
    magnification = d.detach().double().mul(virtual_scale).div_(reach).clamp_(1, torch.finfo(d.dtype).max)
    exponents = growth_d.to(d) * magnification.to(d.dtype).log_()
    return exponents.clamp(-LOG_GROWTH_MAX, LOG_GROWTH_MAX).exp()


def culling_threshold(tau: float, virtual_scale: Scale) -> Scale:
    """``tau s``: a Gaussian whose attenuated opacity is not above this is culled. The only definition."""
    return tau * virtual_scale


def log_threshold(tau: float, virtual_scale: float) -> float:
    """Logarithm of ``culling_threshold``; log a'' must exceed it. At least that of FAINTEST, for s = 0."""
    return math.log(max(culling_threshold(tau, virtual_scale), FAINTEST))


def check_dial(virtual_scale: float) -> None:
    """Raises ClodError for a dial that is negative or not finite."""
    require(0 <= virtual_scale < math.inf, "virtual_scale", virtual_scale, "at least 0 and finite")


def warn_of_no_dial(virtual_scale: float, remedy: str, stacklevel: int = 3) -> None:
    """Checks the dial value, and above 1 warns the caller's caller that it has no effect, as there is no sigma_d."""
    check_dial(virtual_scale)
    if virtual_scale > 1:
        much = f"virtual_scale is {virtual_scale:g}, but there is no sigma_d: all Gaussians are drawn as they are"
        warnings.warn(f"{much}; {remedy}", stacklevel=stacklevel)


def conform(**tensors: Tensor) -> list[Tensor]:
    """The tensors in their common dtype, at least float32; raises ClodError unless they are tensors of one [N]."""
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor):
            raise ClodError(f"{name} is no tensor but {type(tensor).__name__}; pass torch.as_tensor of it")
        require(tensor.is_floating_point(), name, tensor.dtype, "floating point: .float()")
    shapes = {name: tuple(t.shape) for name, t in tensors.items()}
    if len(set(shapes.values())) != 1 or any(len(shape) != 1 for shape in shapes.values()):
        raise ClodError("expected one shape [N], got " + ", ".join(f"{name} {shape}" for name, shape in shapes.items()))
    dtype = reduce(torch.promote_types, (t.dtype for t in tensors.values()), torch.float32)
    return [t.to(dtype) for t in tensors.values()]
