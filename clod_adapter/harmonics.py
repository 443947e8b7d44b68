"""A lower SH degree, whose coefficients are fitted to the views instead of cut."""

from collections.abc import Sequence

import torch
from torch import Tensor

from clod_adapter.config import SH_COUNTS, require
from clod_adapter.equation.distances import Place, position_of
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers.reference import sh_basis

RIDGE = 0.01  # of a view: holds coefficients that the views leave open at those that are stored
ROWS = 1 << 15  # Gaussians that are fitted at a time


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
        ClodError: ``sh_degree`` is none of 0 to 3.

    Example:
        >>> small = with_sh_degree(model.gaussians, 1, model.viewpoints)
    """
    require(
        sh_degree in SH_COUNTS, "sh_degree", sh_degree, f"one of {', '.join(map(str, SH_COUNTS))}"
    )
    if gaussians.sh_degree <= sh_degree:
        return gaussians
    kept = SH_COUNTS[sh_degree]
    changes = [
        _fitted(gaussians.means[rows], gaussians.shN[rows], kept, places)
        for rows in torch.arange(len(gaussians), device=gaussians.means.device).split(ROWS)
    ]
    change = torch.cat(changes).to(gaussians.sh0)
    low = gaussians.shN[:, : kept - 1] + change[:, 1:]
    return gaussians.replace(sh0=gaussians.sh0 + change[:, :1], shN=low.contiguous())


def _fitted(means: Tensor, shN: Tensor, kept: int, places: Sequence[Place]) -> Tensor:
    """``[n, kept, 3]`` the changes of the coefficients that remain."""
    high = shN[:, kept - 1 :].double()
    squares = torch.zeros(len(means), kept, kept, dtype=torch.float64, device=means.device)
    products = torch.zeros(len(means), kept, 3, dtype=torch.float64, device=means.device)
    for place in places:
        away = means.double() - position_of(place, means).double()
        distances = away.norm(dim=1, keepdim=True).clamp(min=1e-12)
        basis = sh_basis(away / distances)[:, : kept + high.shape[1]]
        low = basis[:, :kept]
        lost = (basis[:, kept:, None] * high).sum(1)
        squares += low[:, :, None] * low[:, None]
        products += low[:, :, None] * lost[:, None]
    identity = torch.eye(kept, dtype=torch.float64, device=means.device)
    ridge = RIDGE * max(len(places), 1) * identity
    return torch.linalg.solve(squares + ridge, products)
