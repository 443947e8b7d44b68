"""``Gaussians``: a frozen container of a splat's tensors with checked shapes."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from clod_adapter.config import CLASSIC, SH_COUNTS, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError

SH_C0 = 0.28209479177387814
"""The harmonic of degree 0, ``1 / (2 sqrt(pi))``: a colour without higher degrees is ``0.5 + SH_C0 sh0``."""

OPAQUE = 20.0
"""A logit whose opacity is 1 in float32; written instead of +inf, which some readers refuse."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians with the parameters that checkpoints store, and, once adapted, their distance decay.

    Attributes:
        means: ``[N, 3]`` centres, world units.
        quats: ``[N, 4]`` rotations, wxyz, of any length but 0.
        log_scales: ``[N, 3]`` logarithms of the standard deviations along the axes, world units.
        opacity_logits: ``[N]``; the opacity is their sigmoid. +inf means fully opaque.
        sh0: ``[N, 1, 3]`` degree-0 spherical harmonics.
        shN: ``[N, K-1, 3]`` spherical harmonics of degrees 1 and up, K in {1, 4, 9, 16, 25}.
        sigma_d: ``[N]`` distance decay of opacity, or None for a checkpoint without a dial.
        attenuation: settings of the equation that reads ``sigma_d``; None exactly if ``sigma_d`` is None.
        growth_d: ``[N]`` exponent of the growth of the scales with distance and dial (``growth.py``), or None for no
            growth. Needs a ``sigma_d``.
        screen_filter: the filter for rendering, that of training.

    Raises:
        ClodError: a tensor has the wrong shape, or one of sigma_d and attenuation is missing.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh0: Tensor
    shN: Tensor
    sigma_d: Tensor | None = None
    attenuation: AttenuationConfig | None = None
    growth_d: Tensor | None = None
    screen_filter: ScreenFilter = CLASSIC

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,), "sh0": (n, 1, 3)}
        expected |= {name: (n,) for name in ("sigma_d", "growth_d") if getattr(self, name) is not None}
        for name, shape in expected.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ClodError(f"Gaussians.{name} has shape {found}, expected {shape}")
        if self.shN.shape[0] != n or self.shN.shape[2:] != (3,) or self.shN.shape[1] + 1 not in SH_COUNTS.values():
            raise ClodError(
                f"Gaussians.shN has shape {tuple(self.shN.shape)}, expected ({n}, K-1, 3) with K-1 in 0, 3, 8, 15, 24"
            )
        if (self.sigma_d is None) != (self.attenuation is None):
            raise ClodError("Gaussians needs both sigma_d and attenuation, or neither")
        if self.growth_d is not None and self.sigma_d is None:
            raise ClodError("Gaussians with growth_d need a sigma_d")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        return {k - 1: d for d, k in SH_COUNTS.items()}[self.shN.shape[1]]

    @property
    def scales(self) -> Tensor:
        """``[N, 3]`` standard deviations, ``exp(log_scales)``."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """``[N]`` in [0, 1], ``sigmoid(opacity_logits)``."""
        return self.opacity_logits.sigmoid()

    def tensors(self) -> dict[str, Tensor]:
        """The tensor fields by name; without those that are None."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, Tensor)}

    def replace(self, **changes: Tensor | AttenuationConfig | ScreenFilter | None) -> Gaussians:
        """A copy with the named fields replaced."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]

    def select(self, rows: Tensor) -> Gaussians:
        """The Gaussians at ``rows`` (a boolean mask ``[N]`` or indices ``[M]``)."""
        return self.replace(**{name: value[rows] for name, value in self.tensors().items()})

    def without_empty_bands(self) -> Gaussians:
        """A copy without the highest SH degrees whose coefficients are all 0; renders the same image, faster."""
        degree = self.sh_degree
        while degree > 0 and not self.shN[:, SH_COUNTS[degree - 1] - 1 : SH_COUNTS[degree] - 1].any():
            degree -= 1
        return self.without_bands(degree)

    def without_bands(self, degree: int) -> Gaussians:
        """A copy without the SH degrees above ``degree``; itself if it has none."""
        above = degree < self.sh_degree
        return self.replace(shN=self.shN[:, : SH_COUNTS[degree] - 1].contiguous()) if above else self

    def to(self, device: torch.device | str) -> Gaussians:
        """A copy on another device."""
        return self.replace(**{name: value.to(device) for name, value in self.tensors().items()})
