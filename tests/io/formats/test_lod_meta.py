"""``io.formats.lod_meta``: leaves of a streamed set and their error tables. Indexes of splat-transform are in
``tests/cli/export``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clod_adapter.errors import ClodError
from clod_adapter.io.formats.lod_meta import cutting_options, read_leaves, write_errors


def leaf(*counts: int) -> dict[str, Any]:
    """A leaf with so many Gaussians of each level; of 0, without that level."""
    lods = {str(level): {"file": level, "offset": 0, "count": count} for level, count in enumerate(counts) if count}
    return {"bound": {"min": [0, 0, 0], "max": [1, 2, 3]}, "lods": lods}


@pytest.fixture
def centres() -> list[np.ndarray]:
    """Six centres along z, and in the second level the fourth and the second of them."""
    finest = np.array([[0, 0, 5], [0, 0, 1], [0, 0, 9], [3, 0, 9], [0, 0, 2], [0, 0, 3]], np.float32)
    return [finest, finest[[3, 1]]]


def index(path: Path, *leaves: dict[str, Any]) -> Path:
    first, second, third = leaves
    path.write_text(json.dumps({"lodErrors": False, "tree": {"children": [first, {"children": [second, third]}]}}))
    return path


def test_leaves_have_the_halves_across_the_longest_side(tmp_path: Path, centres: list[np.ndarray]) -> None:
    """z first: 1, 1, 2, 3 before 5, 9, 9, 9; then of the latter z again: 5 and one 9 before two 9."""
    path = index(tmp_path / "lod-meta.json", leaf(3, 1), leaf(2), leaf(1, 1))
    _, (low, middle, high) = read_leaves(path, centres)
    assert sorted(low.rows[0]) == [1, 4, 5] and low.rows[1].tolist() == [1] and low.levels == [0, 1]
    assert 0 in middle.rows[0] and len(middle.rows[0]) + len(middle.rows[1]) == 2 and middle.levels == [0]
    assert sorted([*middle.rows[0], *high.rows[0]]) == [0, 2, 3]
    assert high.bound.tolist() == [[0, 0, 0], [1, 2, 3]]


def test_leaves_of_another_cut_are_refused(tmp_path: Path, centres: list[np.ndarray]) -> None:
    path = index(tmp_path / "lod-meta.json", leaf(4), leaf(2), leaf(1, 1))
    with pytest.raises(ClodError, match=r"lod-meta\.json: its leaves are cut in another way"):
        read_leaves(path, centres)
    path.write_text("{}")
    with pytest.raises(ClodError, match="has no tree of leaves"):
        read_leaves(path, centres)


def test_tables_are_written_into_the_leaves(tmp_path: Path) -> None:
    path = tmp_path / "lod-meta.json"
    path.write_text(json.dumps({"counts": [2, 1], "lodErrors": False, "tree": leaf(2, 1)}))
    meta, leaves = read_leaves(path, [np.zeros((2, 3), np.float32), np.zeros((1, 3), np.float32)])
    write_errors(path, meta, leaves, [[0.0, 1 / 3]])
    assert json.loads(path.read_text()) == {"counts": [2, 1], "lodErrors": True, "tree": {
        **leaf(2, 1), "errors": [0.0, 0.3333333],
    }}  # fmt: skip


def test_cutting_options_give_few_hundred_leaves() -> None:
    assert cutting_options(1) == ("--lod-chunk-extent", "0", "--lod-chunk-min", "8")
    words = cutting_options(10_000_000)
    assert 128 <= 10_000_000 / (1024 * int(words[-1])) <= 140
