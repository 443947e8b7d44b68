"""``Gaussians``: a frozen container of a splat's tensors with checked shapes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from clod_adapter._support.arrays import float_tensor
from clod_adapter.config import CLASSIC, SH_COUNTS, AttenuationConfig, ScreenFilter, require
from clod_adapter.errors import ClodError

SH_C0 = 0.28209479177387814
"""The harmonic of degree 0, ``1 / (2 sqrt(pi))``: a colour without higher degrees is
``0.5 + SH_C0 sh0``.
"""

OPAQUE = 20.0
"""A logit whose opacity is 1 in float32; written instead of +inf, which some readers reject."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians with the parameters that checkpoints store, and, once adapted, their dial.

    Fields may be given as numpy arrays, which become float32 tensors. ``gaussians[:100]``,
    ``gaussians[mask]`` and ``gaussians[indices]`` are the Gaussians of these rows. ``a == b`` is
    whether all fields are equal, bit for bit but for the sign of 0.

    Attributes:
        means: ``[N, 3]`` centres, world units.
        quats: ``[N, 4]`` rotations, wxyz, of any length from 1e-15 to 1e15; others are not drawn.
        log_scales: ``[N, 3]`` logarithms of the standard deviations along the axes, world units.
        opacity_logits: ``[N]``; the opacity is their sigmoid. +inf means fully opaque.
        sh0: ``[N, 1, 3]`` degree-0 spherical harmonics.
        shN: ``[N, K-1, 3]`` spherical harmonics of degrees 1 and up, K in {1, 4, 9, 16}.
        sigma_d: ``[N]`` reaches, the distances at which they end, or None for a checkpoint without
            a dial.
        attenuation: settings of the equation that reads ``sigma_d``; None exactly if ``sigma_d`` is
            None.
        growth_d: ``[N]`` exponent of the growth of scales (``attenuation.growth_factors``), or
            None; needs a sigma_d.
        screen_filter: the filter for rendering, that of training.

    Raises:
        ClodError: a tensor has the wrong shape or holds integers, or one of sigma_d and attenuation
            is missing.
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
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, float_tensor(value))
        n = len(self.means)
        shapes = {
            "means": (n, 3),
            "quats": (n, 4),
            "log_scales": (n, 3),
            "opacity_logits": (n,),
            "sh0": (n, 1, 3),
            "sigma_d": (n,),
            "growth_d": (n,),
        }
        harmonics = [(n, count - 1, 3) for count in SH_COUNTS.values()]
        for name, value in self.tensors().items():
            floats = value.is_floating_point()
            require(floats, f"Gaussians.{name}", value.dtype, "floating point: .float()")
            shape = tuple(value.shape)
            allowed = [shapes[name]] if name in shapes else harmonics
            if shape not in allowed:
                expected = " or ".join(map(str, allowed))
                raise ClodError(f"Gaussians.{name} has shape {shape}, expected {expected}")
        if (self.sigma_d is None) != (self.attenuation is None):
            raise ClodError("Gaussians needs both sigma_d and attenuation, or neither")
        if self.growth_d is not None and self.sigma_d is None:
            raise ClodError("Gaussians with growth_d need a sigma_d")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def near(self) -> Tensor | None:
        """``[N]`` bool: the checkpoint's own, without a reach, if there are others that take over;
        None if not.
        """
        if self.sigma_d is None or self.attenuation is None or self.attenuation.near_distance == 0:
            return None
        return self.sigma_d <= 0

    @property
    def whole(self) -> int:
        """The number drawn at s = 0: all, or the near ones. Shares of what is kept are shares of
        these.
        """
        return len(self) if self.near is None else int(self.near.sum())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Gaussians):
            return NotImplemented
        for name, mine in vars(self).items():
            theirs = getattr(other, name)
            if isinstance(mine, Tensor) and isinstance(theirs, Tensor):
                same_kind = (mine.device, mine.dtype) == (theirs.device, theirs.dtype)
                same = same_kind and torch.equal(mine, theirs)
            else:
                same = mine == theirs
            if not same:
                return False
        return True

    __hash__ = None  # type: ignore[assignment]

    def __getitem__(self, rows: slice | Tensor | np.ndarray | Sequence[int]) -> Gaussians:
        """The Gaussians at ``rows``: a slice, a boolean mask ``[N]``, or indices ``[M]``.

        Raises:
            ClodError: a single index, a mask of another length, or an index out of range.
        """
        if not isinstance(rows, slice):
            rows = torch.as_tensor(rows, device=self.means.device)
            # [] is float
            rows = rows.long() if rows.shape == (0,) and rows.dtype != torch.bool else rows
            if rows.dim() != 1 or (rows.dtype == torch.bool and len(rows) != len(self)):
                raise ClodError(
                    f"rows has shape {tuple(rows.shape)}; give a slice, indices [M] or a mask"
                    f" [{len(self)}]"
                )
        try:
            return self.select(rows)
        except IndexError as error:
            raise ClodError(
                f"there are {len(self)} Gaussians, and {str(error).splitlines()[0]}"
            ) from error

    def __repr__(self) -> str:
        """Count, SH degree, dial and device, as in
        ``Gaussians(120,000, SH degree 3, dial to 5 with growth, cpu)``.
        """
        return f"Gaussians({self.summary}, {self.means.device})"

    @property
    def summary(self) -> str:
        """``120,000, SH degree 3, dial to 5 with growth``."""
        dial = "no dial" if self.attenuation is None else describe_dial(self)
        count = f"{self.whole:,}"
        if self.near is not None:
            count += f" and {len(self) - self.whole:,} far"
        return f"{count}, SH degree {self.sh_degree}, {dial}"

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.shN.shape[1])  # d^2 + 2 d coefficients

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
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    def replace(self, **changes: Tensor | AttenuationConfig | ScreenFilter | None) -> Gaussians:
        """A copy with the named fields replaced."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]

    def select(self, rows: Tensor | slice) -> Gaussians:
        """The Gaussians at ``rows`` (a boolean mask ``[N]``, indices ``[M]`` or a slice)."""
        selected = {name: value[rows] for name, value in self.tensors().items()}
        return self.replace(**selected)

    def without_empty_bands(self) -> Gaussians:
        """A copy without the highest SH degrees whose coefficients are all 0; renders the same
        image, faster.
        """
        degree = self.sh_degree
        while degree > 0:
            first = SH_COUNTS[degree - 1] - 1
            last = SH_COUNTS[degree] - 1
            if self.shN[:, first:last].any():
                break
            degree -= 1
        return self.without_bands(degree)

    def without_bands(self, degree: int) -> Gaussians:
        """A copy without the SH degrees above ``degree``; itself if it has none."""
        if degree >= self.sh_degree:
            return self
        return self.replace(shN=self.shN[:, : SH_COUNTS[degree] - 1].contiguous())

    def to(self, device: torch.device | str) -> Gaussians:
        """A copy on another device."""
        moved = {name: value.to(device) for name, value in self.tensors().items()}
        return self.replace(**moved)

    def cpu(self) -> Gaussians:
        """A copy in main memory."""
        return self.to("cpu")


def describe_dial(owner: Any) -> str:
    """``dial to 5 with growth``, of Gaussians or an adapter."""
    growth = "" if owner.growth_d is None else " with growth"
    return f"dial to {owner.attenuation.max_sv:g}{growth}"


class LossNotFinite(Exception):
    """The loss of a training step is not finite."""


def nonfinite_rows(*tensors: Tensor) -> Tensor:
    """``[N]`` bool, the rows with a value that is not finite in any of the tensors ``[N, ...]``."""
    if tensors[0].device.type == "cpu":  # the host would wait for a GPU's answer
        # sums take one pass without extra memory
        sums = [tensor.sum() for tensor in tensors]
        if all(bool(total.isfinite()) for total in sums):
            return torch.zeros(len(tensors[0]), dtype=torch.bool, device="cpu")
    rows = []
    for tensor in tensors:
        finite = tensor.isfinite().reshape(len(tensor), tensor.shape[1:].numel())
        rows.append(~finite.all(1))
    return torch.stack(rows).any(0)


def require_finite(gaussians: Gaussians, what: str, remedy: str) -> None:
    """Raises ClodError, ``what`` being its subject and ``remedy`` its end, where an attribute is
    not finite.
    """
    for name, values in gaussians.tensors().items():
        if name == "opacity_logits":
            values = torch.where(values.isinf(), 0.0, values)  # +-inf are opacities of 1 and 0
        rows = nonfinite_rows(values).nonzero()
        if len(rows):
            raise ClodError(
                f"{what}: {name} is not finite in {len(rows):,} rows (the first is"
                f" {int(rows[0, 0])}); {remedy}"
            )


def largest_colour(gaussians: Gaussians) -> str:
    """The largest colour coefficient and its row, for the message about an image that overflows."""
    colours = {name: getattr(gaussians, name).abs().flatten(1) for name in ("sh0", "shN")}
    rows = {name: values.amax(1) for name, values in colours.items() if values.numel()}
    name = max(rows, key=lambda attribute: float(rows[attribute].max()))
    value, row = rows[name].max(0)
    return f"the largest {name} is {float(value):.3g}, in row {int(row)}: leave out such rows"


def with_near(near: Gaussians, far: Gaussians) -> Gaussians:
    """The near Gaussians, whose own dial plays no part, and after them far ones, whose dial has a
    near_distance.

    The result has the SH degree of ``near``, which is that of ``far`` or a higher one.
    """
    joined = far.tensors()
    missing = near.shN.shape[1] - far.shN.shape[1]
    joined["shN"] = pad(far.shN, (0, 0, 0, missing))
    for name, value in joined.items():
        dial = name in ("sigma_d", "growth_d")
        first = near.means.new_zeros(len(near)) if dial else getattr(near, name)
        joined[name] = torch.cat([first, value.to(first)])
    return far.replace(**joined)
