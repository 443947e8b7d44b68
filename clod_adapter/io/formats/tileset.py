"""3D Tiles 1.1 (OGC 22-025r4): ``tileset.json`` over ``.glb`` files of several levels, for
CesiumJS.

The root has the coarsest level of the whole scene. Its children are cells of at most LARGEST
Gaussians of the finest level, each a chain of tiles from the next finer level to the finest; a tile
replaces its parent (refine REPLACE). A tile with ``geometricError`` g is shown from the distance
``g f / ALLOWED`` on, with a focal length of f pixels (OGC 22-025r4, "Geometric error"). So g is
ALLOWED / FOCAL times the distance at which its level begins. That of the index, of showing nothing,
is ALLOWED diagonals of the root's box and the root's own error: a set is drawn until it is about
one pixel large.

Viewers turn glTF's y-up axes into z-up ones, (x, y, z) to (x, -z, y), after the node's half turn.
So a point (x, y, z) of the model is at (-x, -z, -y) of the tile set, in which the bounding boxes
are.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clod_adapter._support.arrays import float64_array
from clod_adapter._support.text import package_version
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.formats.tile import EXTENSION, SPZ, write_tile
from clod_adapter.origin import Origin

TILESET = "tileset.json"
ALLOWED = 16.0  # pixels of screen-space error that viewers allow by default
FOCAL = 935.0  # pixels, of a view 60 degrees and 1,080 pixels high
LARGEST = 1 << 18  # Gaussians of the finest level in a cell, unless they share one centre
STRAY = 0.02  # share of the centres that may be outside of a tile's box, along each axis

Rows = list[np.ndarray]  # the row numbers of each level


def write_tileset(
    folder: Path, levels: Sequence[tuple[float, Gaussians]], *, origin: Origin
) -> tuple[str, ...]:
    """Writes ``tileset.json`` and its tiles to an existing folder; what the files do not store.

    Args:
        levels: distance in world units at which each begins, and its Gaussians, without a dial; the
            finest first.
    """
    notes: list[str] = []
    errors = [ALLOWED / FOCAL * begins for begins, _ in levels]
    detail = [gaussians for _, gaussians in levels]
    centres = [float64_array(level.means) for level in detail]

    def tile(level: int, rows: Rows, name: str, children: list[dict[str, Any]]) -> dict[str, Any]:
        """A tile and its file; without one where it has no Gaussians."""
        box = {"box": _box(centres, rows, origin)}
        entry: dict[str, Any] = {"boundingVolume": box, "geometricError": errors[level]}
        if len(rows[level]):
            gaussians = detail[level].select(torch.from_numpy(rows[level]))
            notes.extend(write_tile(folder / name, gaussians, origin))
            entry["content"] = {"uri": name}
        if children:
            entry["children"] = children
        return entry

    coarsest = len(levels) - 1
    chains = []
    scene = [np.arange(len(points)) for points in centres]
    for cell, rows in enumerate(_cells(centres, scene)):
        chain: list[dict[str, Any]] = []
        for level in range(coarsest):
            chain = [tile(level, rows, f"{cell}_{level}.glb", chain)]
        chains += chain
    root = tile(coarsest, scene, "root.glb", chains) | {"refine": "REPLACE"}
    extensions = {"extensionsUsed": [EXTENSION, SPZ], "extensionsRequired": [EXTENSION, SPZ]}
    half_diagonal = float(np.linalg.norm(root["boundingVolume"]["box"][3:]))
    index = {
        "asset": {"version": "1.1", "generator": f"clod-adapter {package_version()}"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": extensions},
        "geometricError": errors[coarsest] + ALLOWED * 2 * half_diagonal,
        "root": root,
    }
    (folder / TILESET).write_text(json.dumps(index, indent=1), encoding="utf-8")
    return tuple(dict.fromkeys(notes))


def _cells(centres: Sequence[np.ndarray], rows: Rows) -> Iterator[Rows]:
    """The rows of each cell: halves of the finest level's, across the longest side."""
    inside = centres[0][rows[0]]
    if len(inside) <= LARGEST or not np.ptp(inside, 0).any():
        yield rows
        return
    axis = int(np.argmax(np.ptp(inside, 0)))
    plane = float(np.median(inside[:, axis]))
    if not (inside[:, axis] < plane).any():
        plane = float(inside[inside[:, axis] > plane, axis].min())
    low: Rows = []
    high: Rows = []
    for points, level in zip(centres, rows, strict=True):
        below = points[level, axis] < plane
        low.append(level[below])
        high.append(level[~below])
    yield from _cells(centres, low)
    yield from _cells(centres, high)


def _box(centres: Sequence[np.ndarray], rows: Rows, origin: Origin) -> list[float]:
    """A box around the centres of all levels but STRAY of them, as 3D Tiles has it: the centre and
    three half axes.

    Viewers take the distance to the box for the choice of levels. Floaters far off would put the
    viewer inside.
    """
    points = np.concatenate([centre[level] for centre, level in zip(centres, rows, strict=True)])
    shares = [STRAY / 2, 1 - STRAY / 2]
    ends = np.quantile(points, shares, 0) + np.array(origin)
    turned = -ends[::-1, [0, 2, 1]]
    centre = turned.mean(0)
    half = (turned[1] - turned[0]) / 2
    return [*centre.tolist(), *np.diag(half).ravel().tolist()]
