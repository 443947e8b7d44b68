"""Whether the default settings fit the sigma_d of a file without settings."""

from __future__ import annotations

import torch
from torch import Tensor

from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.equation.units import nominal_distance
from clod_adapter.io.settings import WARNING

# Adapted files of three captures keep 38 to 97 % here, with sigma_d in other units 3 to 43 %.
DOUBTFUL = 0.25


@torch.no_grad()
def check_plausible(means: Tensor, opacity_logits: Tensor, sigma_d: Tensor, config: AttenuationConfig) -> list[str]:
    """A line with the share kept at s = 1 from the nominal distance; a warning where it is too small.

    A sigma_d that is too small gives a small share: one in units of a distance (as earlier versions wrote),
    or of a file whose positions were enlarged. One that is too large is not detected. Empty for normalisers other than
    ``scene``, which are invariant to scale.

    Args:
        means: ``[N, 3]`` world units; the others ``[N]``, finite but for opacity_logits of +inf; N > 0.
    """
    if config.normalizer != "scene":
        return []
    d = nominal_distance(means, config)
    kept = attenuate(opacity_logits, sigma_d, torch.full_like(sigma_d, d), 1.0, config).keep
    share = float(kept.double().mean())
    reading = (
        f"sigma_d in world units, tau {config.tau:g}, {config.cut} cut: keeps {share:.0%} at s = 1 from {d:.3g} away"
    )
    if share < DOUBTFUL:
        return [
            f"{WARNING}its dial is not described in the file; read as {reading}, likely not what was adapted; give the "
            "file as clod-adapt wrote it, before another tool rewrote or rescaled it"
        ]
    return [f"its dial is not described in the file; read as {reading}; not right if another tool rescaled it"]
