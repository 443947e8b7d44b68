"""Checkpoints without some of their rows and SH bands, every other column as it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from clod_adapter.adapter import trim
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.ply.columns import column_map


def trimmed(checkpoint: Checkpoint, kept: Tensor | None, sh_degree: int | None) -> Checkpoint:
    """The checkpoint with the rows that are ``kept`` (bool ``[N]``) and the bands up to ``sh_degree``; None for all.

    ``f_rest_*`` are numbered channel by channel, so with fewer bands a number means another coefficient: the values
    move, the columns that stay keep their order.
    """
    if kept is None and sh_degree is None:
        return checkpoint
    gaussians, vertex = trim(checkpoint.gaussians, kept, sh_degree), checkpoint.vertex
    vertex = vertex if kept is None else vertex[kept.cpu().numpy()]
    before, after = (column_map(g.sh_degree)["shN"] for g in (checkpoint.gaussians, gaussians))
    if before != after:
        gone = set(before) - set(after)
        fewer = np.empty(len(vertex), [(n, vertex.dtype[n]) for n in vertex.dtype.names or () if n not in gone])
        of = dict(zip(after, before, strict=False))  # both list coefficient by coefficient, of which the first stay
        for name in fewer.dtype.names or ():
            fewer[name] = vertex[of.get(name, name)]
        vertex = fewer
    return replace(checkpoint, gaussians=gaussians, vertex=vertex)
