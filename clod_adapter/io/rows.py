"""What every reader makes of a file: rows in Inria's layout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clod_adapter.origin import Origin


@dataclass(frozen=True)
class Rows:
    """The Gaussians of a file as the columns that a PLY of them has.

    Attributes:
        vertex: ``[N]`` structured array, native byte order, with the columns of ``column_map(sh_degree)`` at least.
        sh_degree: 0 to 4.
        comments: of the header, where there is one.
        notes: what is to be known of the file, one line each.
        settled: whether the format says that opacities are logits and scales logarithms; if not, their range is
            looked at.
        origin: what the file says its coordinates are to be relative to, world units; they are not so here.
    """

    vertex: np.ndarray
    sh_degree: int
    comments: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    settled: bool = False
    origin: Origin | None = None
