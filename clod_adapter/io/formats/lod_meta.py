"""``lod-meta.json``, the index of PlayCanvas's streamed sets: which Gaussians each leaf has, and its table of errors.

splat-transform writes the index, and cuts the scene by a k-d tree over the centres of all levels. The cuts are repeated
here, as the chunks of a set store rounded centres.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter.errors import ClodError

LEAVES, SMALLEST = 128, 8  # fewest leaves of a large set, and thousands (1,024) of Gaussians below which none is cut
TIES = 0.01  # of the Gaussians, the share that may be in other leaves: a cut may pass between copies of one centre


@dataclass(frozen=True)
class Leaf:
    """A block of a streamed set.

    Attributes:
        node: its object in the index.
        rows: int64, those of its Gaussians in each of the L levels; empty where the leaf lacks a level.
    """

    node: dict[str, Any]
    rows: tuple[np.ndarray, ...]

    @property
    def levels(self) -> list[int]:
        """The levels that the leaf has, the finest first."""
        return sorted(int(level) for level in self.node["lods"])

    @property
    def bound(self) -> np.ndarray:
        """``[2, 3]`` the lowest and the highest corner of its Gaussians' boxes, world units."""
        return np.array([self.node["bound"]["min"], self.node["bound"]["max"]], np.float64)


def cutting_options(count: int) -> tuple[str, ...]:
    """splat-transform's options for leaves of a scene of ``count`` Gaussians over all levels, in any unit of length.

    By default it cuts what is wider than 16 units, which suits a scene in metres only.
    """
    return "--lod-chunk-extent", "0", "--lod-chunk-min", str(max(SMALLEST, count // (1024 * LEAVES)))


def read_leaves(path: Path, centres: Sequence[np.ndarray]) -> tuple[dict[str, Any], list[Leaf]]:
    """The index of a set and its leaves.

    Args:
        centres: ``[N_l, 3]`` float32 of each level, the finest first, in the order of the files it was made from.

    Raises:
        ClodError: it has no tree, or its leaves have other numbers of Gaussians than these centres give.
    """
    meta = json.loads(path.read_text(encoding="utf-8"))
    if "tree" not in meta:
        raise ClodError(f"{path.name}: has no tree of leaves")
    points, starts = np.concatenate(centres), np.cumsum([0, *map(len, centres)])
    leaves = []
    for node, rows in cut_tree(meta["tree"], points, np.arange(len(points))):
        ordered = np.sort(rows)
        at = np.searchsorted(ordered, starts)
        parts = zip(starts, at, at[1:], strict=False)
        leaves.append(Leaf(node, tuple(ordered[first:last] - start for start, first, last in parts)))
    others = sum(
        abs(len(rows) - leaf.node["lods"].get(str(level), {"count": 0})["count"])
        for leaf in leaves
        for level, rows in enumerate(leaf.rows)
    )
    if others > TIES * len(points):
        raise ClodError(f"{path.name}: its leaves are cut in another way than by splat-transform 3.7")
    return meta, leaves


def cut_tree(node: dict[str, Any], points: np.ndarray, rows: np.ndarray) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Each leaf below a node and the rows of ``points [N, 3]`` in it: halves by count across the longest side."""
    if "lods" in node:
        yield node, rows
        return
    inside = points[rows].astype(np.float64)
    axis, middle = int(np.argmax(np.ptp(inside, 0))), len(rows) // 2
    order = np.argpartition(inside[:, axis], middle)
    for child, part in zip(node["children"], (order[:middle], order[middle:]), strict=True):
        yield from cut_tree(child, points, rows[part])


def write_errors(path: Path, meta: dict[str, Any], leaves: Sequence[Leaf], errors: Sequence[Sequence[float]]) -> None:
    """Writes the index with a table of errors in each leaf, one number per level of the set."""
    for leaf, table in zip(leaves, errors, strict=True):
        leaf.node["errors"] = [float(f"{error:.7g}") for error in table]
    path.write_text(json.dumps({**meta, "lodErrors": True}, separators=(",", ":")), encoding="utf-8")
