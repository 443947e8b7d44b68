"""What is on disk while a checkpoint is adapted."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import clod_adapter
from clod_adapter.cli.adapt.memory import move_to_disk, rows_on_disk


def test_rows_are_on_disk_until_they_are_written(capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a file without a name; in memory where there is no room for it. Both write the same output."""
    base = clod_adapter.load(capture.ply)
    mapped = rows_on_disk(base, tmp_path)
    assert isinstance(mapped.vertex.base, np.memmap) and not list(tmp_path.iterdir())
    assert np.array_equal(mapped.vertex, base.vertex) and mapped.vertex.dtype == base.vertex.dtype
    assert rows_on_disk(base, tmp_path / "absent").vertex is base.vertex
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=3 * base.vertex.nbytes))
    assert rows_on_disk(base, tmp_path).vertex is base.vertex
    for name, each in (("a.ply", base), ("b.ply", mapped)):
        clod_adapter.save(tmp_path / name, base.gaussians, replace(each, gaussians=base.gaussians))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_tensors_move_to_disk_for_all_that_refer_to_them(capture: Any, tmp_path: Path) -> None:
    base, same = (clod_adapter.load(capture.ply).gaussians for _ in range(2))
    other = base.replace(opacity_logits=base.opacity_logits.clone())
    move_to_disk(base, tmp_path)
    assert not list(tmp_path.iterdir())
    for name, tensor in base.tensors().items():
        assert torch.equal(tensor, getattr(same, name))
        shared = getattr(other, name)
        assert (shared.data_ptr() == tensor.data_ptr()) == (name != "opacity_logits"), name
    base.means[0] = 1.0  # a private copy of the page
