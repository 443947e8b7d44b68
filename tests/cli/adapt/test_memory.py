"""The rows of the checkpoint's file while it is adapted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import clod_adapter
from clod_adapter.cli.adapt.memory import rows_on_disk


def test_rows_are_on_disk_until_they_are_written(capture: Any, tmp_path: Path) -> None:
    """In a file without a name; in memory where there is no room for it. Both write the same output."""
    base = clod_adapter.load(capture.ply)
    mapped = rows_on_disk(base, tmp_path)
    assert isinstance(mapped.vertex.base, np.memmap) and not list(tmp_path.iterdir())
    assert np.array_equal(mapped.vertex, base.vertex) and mapped.vertex.dtype == base.vertex.dtype
    assert rows_on_disk(base, tmp_path / "absent") is base
    for name, each in (("a.ply", base), ("b.ply", mapped)):
        clod_adapter.save(tmp_path / name, base.gaussians, replace(each, gaussians=base.gaussians))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
