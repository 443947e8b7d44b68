"""A lower SH degree, whose coefficients are fitted to the views instead of cut."""

from collections.abc import Sequence

import torch
from torch import Tensor

from clod_adapter.config import SH_COUNTS, require
from clod_adapter.equation.distances import Place, position_of
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers.reference import sh_basis

RIDGE = 0.01  # of a view: holds coefficients that the views leave open at those that are stored
PAIRS = 1 << 17  # Gaussians times places that are fitted at a time


@torch.no_grad()
def with_sh_degree(gaussians: Gaussians, sh_degree: int, places: Sequence[Place]) -> Gaussians:
    """The Gaussians with this SH degree, or their own if it is lower, and the colours that cameras
    see kept.

    With the basis ``B(v)`` in the direction from camera v, split into low and high degrees, the low
    coefficients change by the ``c`` that minimises
    ``sum over v of |B_low(v) c - B_high(v) h_high|^2 + RIDGE V |c|^2``: linear least squares for
    each Gaussian and channel, over V cameras.

    Args:
        places: cameras, or viewpoints; as many as possible, from where the result is to be seen.

    Raises:
        ClodError: ``sh_degree`` is none of 0 to 3, or there is no place.

    Example:
        >>> small = with_sh_degree(model.gaussians, 1, model.viewpoints)
    """
    require(
        sh_degree in SH_COUNTS, "sh_degree", sh_degree, f"one of {', '.join(map(str, SH_COUNTS))}"
    )
    if gaussians.sh_degree <= sh_degree:
        return gaussians
    require(len(places) > 0, "the number of places", len(places), "at least 1")
    kept = SH_COUNTS[sh_degree]
    positions = torch.stack([position_of(place, gaussians.means) for place in places])
    rows = max(PAIRS // len(places), 1)
    blocks = zip(gaussians.means.split(rows), gaussians.shN.split(rows), strict=True)
    changes = [_fitted(means, shN, kept, positions) for means, shN in blocks]
    change = torch.cat(changes).to(gaussians.sh0)
    low = gaussians.shN[:, : kept - 1] + change[:, 1:]
    return gaussians.replace(sh0=gaussians.sh0 + change[:, :1], shN=low.contiguous())


def _fitted(means: Tensor, shN: Tensor, kept: int, positions: Tensor) -> Tensor:
    """``[n, kept, 3]`` the changes of the coefficients that remain."""
    high = shN[:, kept - 1 :].double()
    away = means[:, None].double() - positions.double()
    directions = away / away.norm(dim=2, keepdim=True).clamp(min=1e-12)
    basis = sh_basis(directions.flatten(0, 1)).unflatten(0, away.shape[:2])
    low = basis[..., :kept]
    lost = basis[..., kept : kept + high.shape[1]] @ high
    ridge = RIDGE * len(positions) * torch.eye(kept, dtype=torch.float64, device=means.device)
    return torch.linalg.solve(low.mT @ low + ridge, low.mT @ lost)
