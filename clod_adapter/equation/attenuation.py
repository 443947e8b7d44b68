"""The dial's equation, and the one function that turns Gaussians, a camera and a dial value into
what is drawn.

For activated opacity ``a``, reach ``R = sigma_d``, growth exponent ``h``, normalised distance ``d``
(``distances.py``) and dial ``s`` (the paper's virtual distance scale)::

    t = d s / R                    0 where d s is 0
    kept iff t < 1
    f = 1 - t^4                    fade; a f is drawn
    m = max(1, d s / r)            r: d at the median distance in the nearest training views
    g = m^h                        factor of the scales of what is kept, in [e^-20, e^20]

Every Gaussian has a reach: the distance, at s = 1, at which it ends. At the dial value s it ends at
R / s: moving away and turning the dial are one effect, and the kept sets are nested in both.
Opacity has no part in the cut. At s = 0 everything is drawn as it is stored, and so is a Gaussian
with an infinite ``sigma_d``.

With a ``near_distance`` H, Gaussians of two kinds are in one file: near ones, the checkpoint's own,
whose ``sigma_d`` is 0, and fewer far ones, which take over from them in a narrow zone. With
``x = d s / H``, in one unit::

    w = min(max(12 x^2 - 11, 0), 1)
    near    kept iff x < 1;               a (1 - w) is drawn
    far     kept iff w > 0 and t < 1;     a w f is drawn

So at s = 0, and nearer than ``0.957 H / s``, the picture is the checkpoint's, bit for bit. Kept
sets are nested within each kind.

Opacity reaches 0 continuously: per unit of ``log s`` or ``log d`` the drawn opacity changes by at
most ``4 a``, as ``df / dlog t = -4 t^4``; within the zone by at most ``24 a`` more. Nearer than
r / s nothing grows.

Sources: decay and culling by distance and dial follow "CLoD-GS: Continuous Level-of-Detail via 3D
Gaussian Splatting", ICLR 2026, whose own form, with an exponential and an absolute threshold, is
``paper.py`` (``AttenuationConfig.form``). g is this project's, after stochastic simplification of
aggregate detail (Cook, Halstead, Planck and Ryu, SIGGRAPH 2007), where the elements that remain
grow to preserve the area.

Tensors are ``[N]``, one entry per Gaussian, on one device. ``opacity_logits`` may be +-inf.
Distances are finite and >= 0. Half-precision inputs are computed in float32, and so are their
results; otherwise the result has the inputs' common dtype. The fade is computed in float64.

Accuracy, measured against mpmath (benchmarks/stability_equation.py), as relative errors: drawn
opacities are within ``2 finfo.eps + 2^-52 / (1 - t)``, and so is their gradient by a logit as a
share of them; that by sigma_d is within ``6 finfo.eps``. g is within ``4 + 2 |h| (1 + log m)`` of
finfo.eps, its slope within ``2 / log m`` more.
"""

import math
import warnings
from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig, number, require
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.paper import paper_fade
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians

SIGMA_MAX = 1e9
"""Stands for an infinite sigma_d: f is exactly 1 for d s < 1e7 in float32, d s < 8e4 in float64."""

# Range of trained exponents. 3/4 preserves area where counts fall as s^-1.5; above 1 a Gaussian far
# away grows on the screen.
GROWTH_RANGE = (-1.0, 3.0)
LOG_GROWTH_MAX = 20.0  # of abs(log g)
TAKEOVER = 12.0  # far Gaussians begin at sqrt(1 - 1/12) H


class Attenuated(NamedTuple):
    """Opacities, culling and growth at one dial value.

    Attributes:
        drawn: ``[N]`` opacities ``a f``, the rasterizer's input, in [0, 1]; 0 where the Gaussian is
            culled.
        keep: ``[N]`` bool, the Gaussians that are not culled.
        growth: ``[N]`` factor of the scales (``growth_factors``); ones without a ``growth_d``.
    """

    drawn: Tensor
    keep: Tensor
    growth: Tensor


def attenuate(
    opacities: Tensor,
    sigma_d: Tensor | None,
    seen_from: Tensor | tuple[Tensor, Camera],
    virtual_scale: float,
    config: AttenuationConfig | None,
    *,
    activated: bool = False,
    growth_d: Tensor | None = None,
) -> Attenuated:
    """Attenuates Gaussians for one dial value. Rendering, training, baking and renderers'
    hooks all call this.

    Differentiable in ``opacities``, ``sigma_d`` and ``growth_d``, not in distances. Without a
    ``sigma_d`` or ``config`` all are kept, drawn with a, and nothing grows. In the equation above,
    what is kept at s is kept at every smaller dial value, except far Gaussians.

    Args:
        opacities: ``[N]`` logits.
        sigma_d: ``[N]`` reaches R, in the units of distances.
        seen_from: ``[N]`` distances d (``distances.normalized_distances``), or the centres
            ``[N, 3]``, world units, and the camera. Pass distances to use them for several dial
            values.
        virtual_scale: the dial s, >= 0.
        activated: ``opacities`` are a itself, in [0, 1], as rasterizers take them.
        growth_d: ``[N]`` exponents h of the growth of the scales, finite; None for no growth.

    Raises:
        ClodError: the dial is negative or not finite, or the shapes differ.
    """
    check_dial(virtual_scale)
    virtual_scale = float(virtual_scale)  # it may be a numpy scalar or a 0-d array
    if sigma_d is None or config is None:
        a = opacities if activated else opacities.sigmoid()
        return Attenuated(a, torch.ones_like(a, dtype=torch.bool), torch.ones_like(a))
    d = normalized_distances(*seen_from, config) if isinstance(seen_from, tuple) else seen_from
    name = "opacities" if activated else "opacity_logits"
    opacities, sigma, d = conform(**{name: opacities}, sigma_d=sigma_d, d=d)
    if growth_d is None:
        growth = torch.ones_like(d)
    else:
        conform(sigma_d=sigma_d, growth_d=growth_d)
        growth = growth_factors(growth_d, d, virtual_scale, growth_distance(config))
    a = opacities if activated else opacities.sigmoid()
    far = d.detach().double() * virtual_scale
    if config.form == "paper":
        fade, keep = paper_fade(a, sigma, far, virtual_scale)
    else:
        fade, keep = reach_fade(sigma, far, config.near_distance / config.scene_distance)
    return Attenuated(a * fade.to(a), keep, growth)


def reach_fade(sigma_d: Tensor, far: Tensor, near: float = 0.0) -> tuple[Tensor, Tensor]:
    """The fade f, float64, differentiable in ``sigma_d``, and which Gaussians are kept; ``far`` is
    d s, float64.

    ``near``: H, in the unit of ``far``; 0 where there are no near Gaussians.
    """
    keep = (far < sigma_d) | (far == 0)
    fades = keep & (far > 0)
    # t is 1 / 1 where a Gaussian is culled, which has no gradient, and 0 / 1 where d s is 0
    t = torch.where(keep, far, 1) / sigma_d.double().where(fades, 1)
    fade = 1 - t.square().square()  # as a product, the slope of a small t would cancel
    if near == 0:
        return fade, keep
    taken_over = takeover(far, near)
    is_near = sigma_d <= 0
    keep = torch.where(is_near, far < near, keep & (taken_over > 0))
    return torch.where(is_near, 1 - taken_over, fade * taken_over), keep


def takeover(far: Tensor, near: float) -> Tensor:
    """w, in [0, 1]: the share that far Gaussians have taken over from near ones; ``far`` is d s."""
    progress = (far / near).square() * TAKEOVER - (TAKEOVER - 1)
    return progress.clamp(0, 1)


def takeover_distance(config: AttenuationConfig, share: float) -> float:
    """d s at which ``takeover`` is ``share``, in (0, 1], or where it begins, for 0; 0 where there
    are no near Gaussians.
    """
    return math.sqrt(1 - (1 - share) / TAKEOVER) * config.near_distance / config.scene_distance


def kept_between(
    gaussians: Gaussians,
    distances: Tensor,
    baked: bool = False,
) -> tuple[Tensor, Tensor]:
    """``[N]`` float64 twice, begin and end of the dial values at which each Gaussian is kept at its
    distance d ``[N]``, the end excluded: by the equation, or with ``baked`` in the file that
    ``bake`` makes, where near and far ones change at once, in the middle of the zone.
    """
    config = gaussians.attenuation
    assert gaussians.sigma_d is not None and config is not None
    d = distances.double()
    begin = torch.zeros_like(d)
    end = (gaussians.sigma_d.double() / d).masked_fill(d == 0, math.inf)
    near = gaussians.near
    if near is None:
        return begin, end
    shares = (0.5, 0.5) if baked else (0, 1)
    first, last = (takeover_distance(config, share) for share in shares)
    return torch.where(near, begin, first / d), torch.where(near, last / d, end)


def smallest_dial(
    fits: Callable[[float], bool],
    low: float,
    high: float,
    precision: float,
) -> float:
    """The smallest dial value that ``fits``, by bisection of log s, to a relative precision.

    Args:
        low, high: values of which the first does not fit and the last does.
    """
    while high / low > 1 + precision:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high


def dial(gaussians: Gaussians, seen_from: Camera | Tensor, virtual_scale: float) -> Attenuated:
    """``attenuate`` of Gaussians, seen from a camera, or from distances d ``[N]`` where these are
    known.
    """
    where = seen_from if isinstance(seen_from, Tensor) else (gaussians.means, seen_from)
    return attenuate(
        gaussians.opacity_logits,
        gaussians.sigma_d,
        where,
        virtual_scale,
        gaussians.attenuation,
        growth_d=gaussians.growth_d,
    )


def growth_distance(config: AttenuationConfig) -> float:
    """r: ``reference_distance`` in units of ``scene_distance``; 1 if it is unknown, or in the
    paper's form.
    """
    if config.form == "paper" or config.reference_distance == 0:
        return 1.0
    return config.reference_distance / config.scene_distance


def growth_factors(
    growth_d: Tensor,
    d: Tensor,
    virtual_scale: float | Tensor,
    start: float,
) -> Tensor:
    """``[N]`` the factors g of the scales; exactly 1 where ``growth_d`` is 0 or ``d s <= r``.

    Differentiable in ``growth_d [N]``, the finite exponents h: the slope is ``g log m``, and 0
    where g is clamped. Never NaN. The result has the dtype of ``d [N]``, float32 or float64.
    ``start`` is r.
    """
    # d s is float64's: a dial beyond float32 times a distance of 0 would be NaN.
    magnification = d.detach().double().mul(virtual_scale).div_(start)
    magnification.clamp_(1, torch.finfo(d.dtype).max)
    exponents = growth_d.to(d) * magnification.to(d.dtype).log_()
    return exponents.clamp(-LOG_GROWTH_MAX, LOG_GROWTH_MAX).exp()


def check_dial(virtual_scale: float) -> None:
    """Raises ClodError for a dial that is negative or not finite."""
    require(
        0 <= number(virtual_scale) < math.inf,
        "virtual_scale",
        virtual_scale,
        "a finite number of at least 0",
    )


def warn_of_no_dial(virtual_scale: float, remedy: str, stacklevel: int = 3) -> None:
    """Checks the dial value, and above 1 warns the caller's caller that it has no effect, as there
    is no sigma_d.
    """
    check_dial(virtual_scale)
    if virtual_scale > 1:
        warnings.warn(
            f"virtual_scale is {virtual_scale:g}, but there is no sigma_d: all Gaussians are drawn"
            f" as they are; {remedy}",
            stacklevel=stacklevel,
        )


def conform(**tensors: Tensor) -> list[Tensor]:
    """The tensors in their common dtype, at least float32; raises ClodError unless they are tensors
    of one [N].
    """
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor):
            raise ClodError(
                f"{name} is no tensor but {type(tensor).__name__}; pass torch.as_tensor of it"
            )
        require(tensor.is_floating_point(), name, tensor.dtype, "floating point: .float()")
    shapes = {name: tuple(t.shape) for name, t in tensors.items()}
    distinct = set(shapes.values())
    if len(distinct) != 1 or len(distinct.pop()) != 1:
        listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ClodError(f"expected one shape [N], got {listed}")
    dtypes = [tensor.dtype for tensor in tensors.values()]
    dtype = reduce(torch.promote_types, dtypes, torch.float32)
    return [tensor.to(dtype) for tensor in tensors.values()]
