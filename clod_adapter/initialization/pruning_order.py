"""In what order Gaussians can leave, so that for each there is a neighbour to stand in for it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from clod_adapter._kernels import threads
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.progress import Listener, Phase, tell

NEIGHBOURS = 8
LEAVING = 0.25  # of those left, a round
COLOUR_FLOOR = 0.03  # below this difference of colours (of 1) any two are alike
APART = 0.05  # what being far apart counts, beside a squared difference of colours
UNLIKE = 1e12  # for colours or sizes that are not finite
STUCK = 0.02  # of those left: if fewer leave in a round, the cheapest LEAVING do whoever their heirs are
ROWS = 1 << 17  # whose neighbours are held at a time
BLOCK = 1 << 13  # of these, whose likeness is worked out at a time: what stays in cache is three times as fast
CROWD = 64  # Gaussians exactly in one place, from which on they are moved apart,
JITTER = 1e-6  # by so much of their size: a k-d tree cannot part them, and compares each with all others


def pruning_order(gaussians: Gaussians, worth: Tensor, progress: Listener | None = None) -> Tensor:
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
        progress: called after each round, in ``Phase.PRUNING_ORDER``, with the Gaussians ordered so far.

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
        tell(progress, Phase.PRUNING_ORDER, gone, count)
    order[left] = gone
    tell(progress, Phase.PRUNING_ORDER, count, count)
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
    inherits = np.zeros(len(cost), bool)
    inherits[heir[leaving]] = True
    leaving = leaving[~inherits[leaving]]
    # Where many are alike and in one place they all have the same heirs, and would leave one by one.
    return leaving if len(leaving) > STUCK * len(cost) else cheapest


def _heirs(centres: np.ndarray, colours: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The neighbour that is most like each, and how unlike it is."""
    from scipy.spatial import cKDTree  # only here: it takes a fifth of a second to import

    tree, heir, unlike = cKDTree(centres), np.empty(len(centres), np.int64), np.empty(len(centres))
    channels = np.ascontiguousarray(colours.T)
    # In the tree's own order, in which what follows on each other lies together: a third of the time where a file's
    # rows are in none.
    for part in np.array_split(tree.indices, -(-len(centres) // ROWS)):
        apart, near = tree.query(centres[part], min(NEIGHBOURS + 1, len(centres)), workers=threads.worker_count())
        for at in range(0, len(part), BLOCK):
            rows, these = part[at : at + BLOCK], slice(at, at + BLOCK)
            heir[rows], unlike[rows] = _most_alike(rows, near[these].T, apart[these].T, channels, sizes)
    return heir, unlike


def _most_alike(
    rows: np.ndarray, near: np.ndarray, apart: np.ndarray, channels: np.ndarray, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of the neighbours ``near [K, n]`` of ``rows [n]``, so far ``apart``: which is most like, and how unlike it is.

    Args:
        channels: ``[3, N]`` colours.
    """
    heir, least = near[0].copy(), np.full(len(rows), np.inf)
    own, size = channels[:, rows], sizes[rows]
    with np.errstate(invalid="ignore"):  # inf - inf
        for other, distance in zip(near, np.square(apart), strict=True):
            red, green, blue = np.square(own - channels[:, other])
            reach = np.square(size + sizes[other])
            unlike = red + green + blue + COLOUR_FLOOR**2
            unlike += APART * distance / np.maximum(distance + reach, np.finfo(float).tiny)
            unlike = np.nan_to_num(unlike, nan=UNLIKE, posinf=UNLIKE)
            better = (unlike < least) & (other != rows)
            heir[better], least[better] = other[better], unlike[better]
    return heir, least
