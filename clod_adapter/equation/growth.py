"""Growth: the factor by which the Gaussians that remain become larger with distance and dial value.

For an exponent ``h`` (``growth_d``), a normalised distance ``d`` (``distances``) and a dial value ``s``::

    m   = max(1, d s / r)          r: d at the median distance in the nearest training views
    g   = m^h                      factor of the three scales, in [e^-20, e^20]

Opacity fades and scale grows by ``d s``, so that moving away and turning the dial have the same effect. At s = 1
nothing changes nearer than r. Culling has no growth in it: kept sets, counts and extinction scales are CLoD-GS's.

Accuracy, measured against mpmath (benchmarks/stability_equation.py), in relative errors: g is within
``4 + 2 |h| (1 + log m)`` of finfo.eps, and its slope within ``2 / log m`` more.

Source: this project, after stochastic simplification of aggregate detail (Cook, Halstead, Planck and Ryu, SIGGRAPH
2007), where the elements that remain grow to preserve the area. Here the exponent is learned.
"""

import torch
from torch import Tensor

from clod_adapter.config import AttenuationConfig

# Of trained exponents. 3/4 preserves area where counts fall as s^-1.5; above 1 a Gaussian far away grows on the screen.
GROWTH_RANGE = (-1.0, 3.0)
LOG_GROWTH_MAX = 20.0  # of abs(log g)


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
