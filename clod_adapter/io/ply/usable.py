"""Which rows of a checkpoint are Gaussians that can be drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clod_adapter.io.ply.columns import MASKS, column_map


def row_rules(table: np.ndarray, names: Sequence[str]) -> list[tuple[np.ndarray, str]]:
    """For each rule ``[N]`` bool, which rows keep it, and why the others go; a row goes by the first it breaks.

    Args:
        table: ``[N, P]`` float32.
        names: of its columns, those of ``column_map`` at least.
    """
    opacity = table[:, names.index("opacity")]
    finite = np.isfinite(table)
    finite[:, names.index("opacity")] |= opacity == np.inf
    rotated = (table[:, [names.index(name) for name in column_map(0)["quats"]]] != 0).any(1)
    exists = np.ones(len(table), bool)
    if all(name in names for name in MASKS):
        first, second = (table[:, names.index(name)] for name in MASKS)
        exists = ~(first < second)  # as sigmoid(first - second) >= 0.5; NaN is for the next rule
    return [
        (exists, "MaskGaussian existence probability below 0.5"),
        (finite.all(1), "a value is not finite"),
        (rotated, "rotation is zero"),
    ]
