"""The nearest centres of each Gaussian, by a k-d tree."""

from collections.abc import Iterator

import numpy as np

from clod_adapter._kernels import threads

ROWS = 1 << 13  # rows at a time, whose neighbours and their attributes fit in the cache
# A k-d tree cannot split equal points, and compares each with all others.
CROWD = 64  # Gaussians with equal centres, from which on they are displaced
JITTER = 1e-6  # largest displacement, a share of their size


def nearest(centres: np.ndarray, count: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Blocks of rows ``[n]``, and ``[n, K]`` the distances and the rows of the ``count`` nearest,
    after their own.

    In the tree's order, in which successive rows are neighbours: a third of the time for a file in
    random order. There are fewer than ``count`` where there are no more.
    """
    from scipy.spatial import cKDTree  # only here: it takes a fifth of a second to import

    tree = cKDTree(centres)
    neighbours = min(count + 1, len(centres))
    for rows in np.array_split(tree.indices, -(-len(centres) // ROWS)):
        yield rows, *tree.query(centres[rows], neighbours, workers=threads.worker_count())


def without_crowds(centres: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """The centres, displaced by JITTER where too many may be equal."""
    x = np.sort(centres[:, 0])
    if not (x[CROWD:] == x[:-CROWD]).any():
        return centres
    shifts = np.random.default_rng(0).uniform(-JITTER, JITTER, centres.shape)
    return centres + np.nan_to_num(sizes, posinf=0.0)[:, None] * shifts
