"""The pruning order, in which a similar neighbour remains for each Gaussian that is removed."""

import numpy as np
import torch
from torch import Tensor

from clod_adapter._support.arrays import float64_array
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.initialization.neighbours import nearest, without_crowds
from clod_adapter.progress import Listener, Phase, tell

NEIGHBOURS = 8
REMOVED = 0.25  # of the remaining Gaussians, per round
COLOUR_FLOOR = 0.03  # smallest difference of colours (of 1) that counts
APART = 0.05  # weight of the distance, relative to a squared difference of colours
DIFFERENT = 1e12  # dissimilarity for colours or sizes that are not finite
# of the remaining: if a round removes fewer, it removes the cheapest REMOVED without conditions
STUCK = 0.02


def pruning_order(
    gaussians: Gaussians,
    importance: Tensor,
    progress: Listener | None = None,
) -> Tensor:
    """``[N]`` int64, the number of Gaussians removed before each: half-edge collapse, as for the
    levels of a mesh.

    In rounds. Removing Gaussian i costs the minimum over its NEIGHBOURS nearest centres j of
    ``w_i (|c_i - c_j|^2 + COLOUR_FLOOR^2 + APART r^2 / (r^2 + (l_i + l_j)^2))``, with w the
    importance, c the colours of SH degree 0, r the distance of the centres and l the largest
    scales. The cheapest REMOVED of them are removed, except those whose j is cheaper or which are
    the j of a removed one; their importance is added to that of j. Ranking by importance alone
    thins out plain surfaces, whose Gaussians have little importance each, until none is left there
    to grow into the gaps. (Kobbelt, Campagna and Seidel 1998, without quadrics; measured in
    docs/method.md.)
    """
    if not bool(gaussians.means.isfinite().all()):
        raise ClodError("means are not all finite, so neighbours are not defined; remove such rows")
    count = len(gaussians)
    colours = 0.5 + SH_C0 * float64_array(gaussians.sh0[:, 0])
    sizes = float64_array(gaussians.log_scales.double().exp().amax(1))
    weights = float64_array(importance).copy()
    order = np.empty(count, np.int64)
    centres = without_crowds(float64_array(gaussians.means), sizes)
    remaining = np.arange(count)
    removed_count = 0
    while len(remaining) > 1:
        substitute, difference = _substitutes(
            centres[remaining], colours[remaining], sizes[remaining]
        )
        removed = _removed(weights[remaining] * difference, substitute)
        np.add.at(weights, remaining[substitute[removed]], weights[remaining[removed]])
        order[remaining[removed]] = removed_count + np.arange(len(removed))
        removed_count += len(removed)
        remaining = np.delete(remaining, removed)
        tell(progress, Phase.PRUNING_ORDER, removed_count, count)
    order[remaining] = removed_count
    tell(progress, Phase.PRUNING_ORDER, count, count)
    return torch.from_numpy(order).to(importance.device)


def _removed(cost: np.ndarray, substitute: np.ndarray) -> np.ndarray:
    """The rows removed in this round, the cheapest first; at least one."""
    cheapest = cost.argsort(kind="stable")
    rank = np.empty(len(cost), np.int64)
    rank[cheapest] = np.arange(len(cost))
    cheapest = cheapest[: max(int(REMOVED * len(cost)), 1)]
    removed = cheapest[rank[substitute[cheapest]] > rank[cheapest]]
    needed = np.zeros(len(cost), bool)
    needed[substitute[removed]] = True
    removed = removed[~needed[removed]]
    # Many similar Gaussians in one place share one substitute, and would be removed one by one.
    return removed if len(removed) > STUCK * len(cost) else cheapest


def _substitutes(
    centres: np.ndarray,
    colours: np.ndarray,
    sizes: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The most similar neighbour of each, and its dissimilarity."""
    substitute = np.empty(len(centres), np.int64)
    difference = np.empty(len(centres))
    channels = np.ascontiguousarray(colours.T)
    for rows, distances, near in nearest(centres, NEIGHBOURS):
        substitute[rows], difference[rows] = _most_similar(
            rows, near.T, distances.T, channels, sizes
        )
    return substitute, difference


def _most_similar(
    rows: np.ndarray,
    near: np.ndarray,
    distances: np.ndarray,
    channels: np.ndarray,
    sizes: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The most similar of the neighbours ``near [K, n]`` of ``rows [n]``, and its dissimilarity."""
    substitute = near[0].copy()
    least = np.full(len(rows), np.inf)
    colours = channels[:, rows]
    size = sizes[rows]
    with np.errstate(invalid="ignore"):  # inf - inf
        for neighbour, distance in zip(near, np.square(distances), strict=True):
            red, green, blue = np.square(colours - channels[:, neighbour])
            reach = np.square(size + sizes[neighbour])
            dissimilarity = red + green + blue + COLOUR_FLOOR**2
            dissimilarity += APART * distance / np.maximum(distance + reach, np.finfo(float).tiny)
            dissimilarity = np.nan_to_num(dissimilarity, nan=DIFFERENT, posinf=DIFFERENT)
            better = (dissimilarity < least) & (neighbour != rows)
            substitute[better] = neighbour[better]
            least[better] = dissimilarity[better]
    return substitute, least
