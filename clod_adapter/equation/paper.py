"""The paper's form of the equation (CLoD-GS, ICLR 2026, Eq. 2 and its mask M_i), for the paper's
experiments alone.

With distances d as a share of the largest in the view, decay ``sigma``, opacity ``a`` and dial
``s``::

    a'' = a exp(-(d s)^2 / (2 relu(sigma)^2 + EPS))
    kept iff a'' > TAU s                            a kept Gaussian is drawn with a'': a hard cut

The paper gives neither EPS nor TAU. TAU is the opacity below which rasterizers draw nothing.
"""

import math

import torch.nn.functional as F
from torch import Tensor

EPS = 1e-8
TAU = 1 / 255


def decay(sigma_d: Tensor, far: Tensor) -> Tensor:
    """``[N]`` float64, ``u = (d s)^2 / (2 relu(sigma)^2 + EPS)``; ``far`` is d s, float64."""
    return far.square() / (2 * sigma_d.double().relu().square() + EPS)


def paper_fade(
    opacities: Tensor,
    sigma_d: Tensor,
    far: Tensor,
    virtual_scale: float,
) -> tuple[Tensor, Tensor]:
    """``exp(-u)`` where a'' is above the threshold, else 0, differentiable in ``sigma_d``; and
    which are kept.
    """
    fade = (-decay(sigma_d, far)).exp()
    keep = opacities.detach() * fade.detach() > TAU * virtual_scale
    return fade * keep, keep


def soft_count(
    opacity_logits: Tensor,
    sigma_d: Tensor,
    far: Tensor,
    virtual_scale: float,
    width: float,
) -> Tensor:
    """0-d, the share of Gaussians kept, in [0, 1], differentiable in logits and ``sigma_d``; 0 for
    no Gaussians.

    Its gradient is that of the mean of ``sigmoid((log a'' - log(TAU s)) / width)``, straight
    through.
    """
    margin = (
        F.logsigmoid(opacity_logits.double()) - decay(sigma_d, far) - math.log(TAU * virtual_scale)
    )
    soft = (margin / width).sigmoid()
    hard = (margin.detach() > 0).double()
    count = hard + soft - soft.detach()
    return count.sum() / max(len(margin), 1)
