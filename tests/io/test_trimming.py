"""Checkpoints with fewer rows and bands: what stays is what was there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from clod_adapter.adapter import trim
from clod_adapter.io.checkpoint import Checkpoint, blank, load, save, trimmed
from clod_adapter.io.ply.columns import rows_of
from scenes import gaussians


@pytest.fixture
def checkpoint(tmp_path: Path) -> Checkpoint:
    """Degree 2, properties in another order, and one that nobody knows."""
    g = gaussians(9, 2, 0)
    vertex = rows_of({name: value.numpy() for name, value in g.tensors().items()}, 2)
    names = [*reversed(vertex.dtype.names), "label"]
    shuffled = np.empty(9, [(name, "u1" if name == "label" else "f4") for name in names])
    for name in names:
        shuffled[name] = np.arange(9) if name == "label" else vertex[name]
    path = tmp_path / "base.ply"
    PlyData([PlyElement.describe(shuffled, "vertex")]).write(str(path))
    return load(path)


@pytest.mark.parametrize("degree", [None, 1, 0])
@pytest.mark.parametrize("rows", [None, [1, 4, 8]])
def test_what_stays_is_as_it_was(tmp_path: Path, checkpoint: Checkpoint, rows: list[int] | None, degree: int) -> None:
    kept = None if rows is None else torch.isin(torch.arange(9), torch.tensor(rows))
    less = trimmed(checkpoint, kept, degree)
    want = trim(checkpoint.gaussians, kept, degree)
    save(tmp_path / "less.ply", less.gaussians, less)
    found = load(tmp_path / "less.ply")
    for name, value in want.tensors().items():
        assert torch.equal(found.gaussians.tensors()[name], value), name
    assert found.vertex["label"].tolist() == (rows or list(range(9)))
    names = [name for name in checkpoint.vertex.dtype.names if name in found.vertex.dtype.names]
    assert list(found.vertex.dtype.names) == names  # in the order of the file
    assert less.fingerprint == checkpoint.fingerprint


def test_nothing_to_trim() -> None:
    base = blank(3, 1)
    assert trimmed(base, None, None) is base
