"""In what order Gaussians can leave, so that for each there is a neighbour to stand in for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clod_adapter.gaussians import SH_C0, Gaussians

NEIGHBOURS = 8
LEAVING = 0.25  # of those left, a round
COLOUR_FLOOR = 0.03  # below this difference of colours (of 1) any two are alike
APART = 0.05  # what being far apart counts, beside a squared difference of colours
_ROWS = 1 << 18  # whose neighbours are held at a time


def leaving_order(gaussians: Gaussians, worth: Tensor, progress: Callable[[float], None] | None = None) -> Tensor:
    """``[N]`` int64, how many leave before each Gaussian: half-edge collapse, as for the levels of a mesh.

    In rounds, what losing Gaussian i costs is ``w_i min_j (|c_i - c_j|^2 + COLOUR_FLOOR^2 + APART r^2 / (r^2 + (l_i +
    l_j)^2))`` over its NEIGHBOURS nearest centres j: colours c of the degree 0, r the distance of the centres, l the
    largest scales. The cheapest LEAVING of them leave, but for those whose j is cheaper or who are somebody's j
    themselves, and hand their worth w on to j. Ranking by worth alone thins out plain surfaces, whose Gaussians are
    each worth little, until nothing is left there to grow into the gaps.

    Source: half-edge collapse (Kobbelt, Campagna and Seidel 1998) with distances between Gaussians in place of
    quadrics; measured in docs/method.md.

    Args:
        worth: ``[N]`` >= 0, what each is worth by itself.
        progress: called with the share of the Gaussians whose place is known.
    """
    from scipy.spatial import cKDTree  # only here: it takes a fifth of a second to import

    centres = gaussians.means.detach().double().numpy()
    colours = 0.5 + SH_C0 * gaussians.sh0.detach()[:, 0].double().numpy()
    sizes = gaussians.log_scales.detach().double().exp().amax(1).numpy() if len(gaussians) else np.empty(0)
    worths, order = worth.detach().double().numpy().copy(), np.empty(len(gaussians), np.int64)
    left, gone = np.arange(len(gaussians)), 0
    while len(left) > 1:
        tree = cKDTree(centres[left])
        found = [
            _heirs(tree, rows, centres[left], colours[left], sizes[left])
            for rows in np.array_split(np.arange(len(left)), -(-len(left) // _ROWS))
        ]
        heir, difference = (np.concatenate(parts) for parts in zip(*found, strict=True))
        dearest_last = (worths[left] * difference).argsort(kind="stable")
        rank = np.empty(len(left), np.int64)
        rank[dearest_last] = np.arange(len(left))
        leaving = dearest_last[: max(int(LEAVING * len(left)), 1)]
        leaving = leaving[rank[heir[leaving]] > rank[leaving]]
        leaving = leaving[~np.isin(leaving, heir[leaving])]
        np.add.at(worths, left[heir[leaving]], worths[left[leaving]])
        order[left[leaving]] = gone + np.arange(len(leaving))
        gone += len(leaving)
        left = np.delete(left, leaving)
        if progress:
            progress(gone / len(order))
    order[left] = gone
    return torch.from_numpy(order)


def _heirs(
    tree: Any, rows: np.ndarray, centres: np.ndarray, colours: np.ndarray, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The neighbour that is most like each of the rows, and how unlike it is."""
    apart, near = tree.query(centres[rows], min(NEIGHBOURS + 1, len(centres)), workers=-1)
    colour = np.square(colours[rows, None] - colours[near]).sum(2)
    reach = np.square(sizes[rows, None] + sizes[near])
    apart = np.square(apart)
    unlike = colour + COLOUR_FLOOR**2 + APART * apart / np.maximum(apart + reach, np.finfo(float).tiny)
    unlike[near == rows[:, None]] = np.inf  # itself
    best = unlike.argmin(1)[:, None]
    return np.take_along_axis(near, best, 1)[:, 0], np.take_along_axis(unlike, best, 1)[:, 0]
