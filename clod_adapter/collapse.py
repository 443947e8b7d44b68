"""In what order Gaussians can leave, so that for each there is a neighbour to stand in for it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from clod_adapter._kernels import threads
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians

NEIGHBOURS = 8
LEAVING = 0.25  # of those left, a round
COLOUR_FLOOR = 0.03  # below this difference of colours (of 1) any two are alike
APART = 0.05  # what being far apart counts, beside a squared difference of colours
UNLIKE = 1e12  # for colours or sizes that are not finite
STUCK = 0.02  # of those left: if fewer leave in a round, the cheapest LEAVING do whoever their heirs are
ROWS = 1 << 18  # whose neighbours are held at a time
CROWD = 64  # Gaussians exactly in one place, from which on they are moved apart,
JITTER = 1e-6  # by so much of their size: a k-d tree cannot part them, and compares each with all others


def leaving_order(gaussians: Gaussians, worth: Tensor, progress: Callable[[int, int], None] | None = None) -> Tensor:
    """``[N]`` int64, how many leave before each Gaussian: half-edge collapse, as for the levels of a mesh.

    In rounds, what losing Gaussian i costs is ``w_i min_j (|c_i - c_j|^2 + COLOUR_FLOOR^2 + APART r^2 / (r^2 + (l_i +
    l_j)^2))`` over its NEIGHBOURS nearest centres j: colours c of the degree 0, r the distance of the centres, l the
    largest scales. The cheapest LEAVING of them leave, but for those whose j is cheaper or who are the j of one that
    leaves, and hand their worth w on to j. Ranking by worth alone thins out plain surfaces, whose Gaussians are each
    worth little, until nothing is left there to grow into the gaps.

    Source: half-edge collapse (Kobbelt, Campagna and Seidel 1998) with distances between Gaussians in place of
    quadrics; measured in docs/method.md.

    Args:
        worth: ``[N]`` >= 0, what each is worth by itself.
        progress: called with the number of Gaussians whose place is known, and of all of them.

    Raises:
        ClodError: a centre is not finite.
    """
    if not bool(gaussians.means.isfinite().all()):
        raise ClodError("means are not all finite: there is no telling which Gaussians are neighbours")
    count = len(gaussians)
    centres = gaussians.means.detach().double().cpu().numpy()
    colours = 0.5 + SH_C0 * gaussians.sh0.detach()[:, 0].double().cpu().numpy()
    sizes = gaussians.log_scales.detach().double().exp().amax(1).cpu().numpy() if count else np.empty(0)
    worths, order = worth.detach().double().cpu().numpy().copy(), np.empty(count, np.int64)
    centres = _apart(centres, sizes)
    left, gone = np.arange(count), 0
    while len(left) > 1:
        heir, unlike = _heirs(centres[left], colours[left], sizes[left])
        leaving = _leaving(worths[left] * unlike, heir)
        np.add.at(worths, left[heir[leaving]], worths[left[leaving]])
        order[left[leaving]] = gone + np.arange(len(leaving))
        gone += len(leaving)
        left = np.delete(left, leaving)
        if progress:
            progress(gone, count)
    order[left] = gone
    if progress:
        progress(count, count)
    return torch.from_numpy(order).to(worth.device)


def _apart(centres: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """The centres, a millionth of a Gaussian's size elsewhere where too many may be in one place."""
    x = np.sort(centres[:, 0])
    if not (x[CROWD:] == x[:-CROWD]).any():
        return centres
    shifts = np.random.default_rng(0).uniform(-JITTER, JITTER, centres.shape)
    return centres + np.nan_to_num(sizes, posinf=0.0)[:, None] * shifts


def _leaving(cost: np.ndarray, heir: np.ndarray) -> np.ndarray:
    """Who leaves in this round, the cheapest first; never nobody."""
    cheapest = cost.argsort(kind="stable")
    rank = np.empty(len(cost), np.int64)
    rank[cheapest] = np.arange(len(cost))
    cheapest = cheapest[: max(int(LEAVING * len(cost)), 1)]
    leaving = cheapest[rank[heir[cheapest]] > rank[cheapest]]
    leaving = leaving[~np.isin(leaving, heir[leaving])]
    # Where many are alike and in one place they all have the same heirs, and would leave one by one.
    return leaving if len(leaving) > STUCK * len(cost) else cheapest


def _heirs(centres: np.ndarray, colours: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The neighbour that is most like each, and how unlike it is."""
    from scipy.spatial import cKDTree  # only here: it takes a fifth of a second to import

    tree, found = cKDTree(centres), []
    for rows in np.array_split(np.arange(len(centres)), -(-len(centres) // ROWS)):
        apart, near = tree.query(centres[rows], min(NEIGHBOURS + 1, len(centres)), workers=threads.worker_count())
        apart, reach = np.square(apart), np.square(sizes[rows, None] + sizes[near])
        with np.errstate(invalid="ignore"):  # inf - inf
            colour = np.square(colours[rows, None] - colours[near]).sum(2)
        unlike = colour + COLOUR_FLOOR**2 + APART * apart / np.maximum(apart + reach, np.finfo(float).tiny)
        unlike = np.nan_to_num(unlike, nan=UNLIKE, posinf=UNLIKE)
        unlike[near == rows[:, None]] = np.inf  # itself
        best = unlike.argmin(1)[:, None]
        found.append((np.take_along_axis(near, best, 1)[:, 0], np.take_along_axis(unlike, best, 1)[:, 0]))
    heir, unlike = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return heir, unlike
