"""How likely a photograph was taken from a camera, by two small renderings of a sample of the Gaussians.

The time of a rendering follows the number of Gaussians, and hundreds of cameras are scored. Beyond SAMPLE of them a
sample is rendered. With the probability p of a Gaussian as in ``sample``, its scales are multiplied by ``p^-1/2``, so
that its projected area times its probability is what it was: surfaces are covered as before, and walls stay opaque.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.render import splat

WIDTH = 496  # of the images that sizes in pixels refer to
SAMPLE = 200_000  # Gaussians that are rendered, about
ROUNDS = 30  # of the search for the probabilities, whose sum is then SAMPLE to a thousandth


def sample(gaussians: Gaussians, rows: Tensor, seed: int) -> tuple[Gaussians, Tensor | None]:
    """About SAMPLE of the Gaussians at ``rows [n]``, and the factors of their scales; all, and None, if n <= SAMPLE.

    A Gaussian is drawn with probability ``p_i = min(1, c l_i)``, l its largest scale and c such that the sum is
    SAMPLE: large ones, of which few cover much, stay as they are.
    """
    if len(rows) <= SAMPLE:
        return gaussians.select(rows).without_empty_bands(), None
    size = largest_scale(gaussians)[rows].double()
    share = size * (SAMPLE / size.sum())
    for _ in range(ROUNDS):
        share = (share * (SAMPLE / share.sum())).clamp_(max=1)
    random = torch.rand(len(rows), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    drawn = random.to(share.device) < share
    return gaussians.select(rows[drawn]).without_empty_bands(), share[drawn].rsqrt().to(gaussians.means)


def score(gaussians: Gaussians, growth: Tensor | None, camera: Camera) -> float:
    """How likely a photograph was taken from here; -inf if the rendering is empty.

    ``log h - 0.5 p - 2 e`` with h the mean magnitude of the higher SH degrees' colour, p the mean log size in pixels
    (both weighted by alpha), e the share of pixels that are not covered.

    Args:
        growth: of ``sample``. p is of the sizes without it.
    """
    higher = torch.zeros_like(gaussians.sh0)  # the colour is then 0.5 + that of the higher degrees
    bands, alpha = splat(gaussians.replace(sh0=higher), gaussians.opacities, camera, growth=growth)
    covered = float(alpha.sum())
    if covered < 0.1 * alpha.numel():
        return -math.inf
    row = camera.viewmat[2].to(gaussians.means)
    depths = gaussians.means @ row[:3] + row[3]
    pixels = largest_scale(gaussians) * WIDTH / camera.width * camera.K[0, 0] / depths.clamp(min=1e-6)
    shade = (pixels.clamp(1e-3, 1e4).log() + 7)[:, None, None].expand(-1, 1, 3)  # positive, as colours are
    plain = gaussians.replace(sh0=(shade - 0.5) / SH_C0, shN=gaussians.shN[:, :0])
    sizes, _ = splat(plain, gaussians.opacities, camera, growth=growth)
    size = float(sizes[..., 0].sum()) / covered - 7
    empty = float((alpha < 0.9).float().mean())
    strength = float((bands - 0.5 * alpha[..., None]).abs().mean(2).sum()) / covered if gaussians.sh_degree else 1.0
    return math.log(strength + 1e-4) - 0.5 * size - 2 * empty


def largest_scale(gaussians: Gaussians) -> Tensor:
    """``[N]`` the largest standard deviation, world units."""
    return gaussians.scales.amax(1)
