"""A COLMAP library for the tests of the scene readers."""

from __future__ import annotations

from typing import Any

import pytest

from clod_adapter.io.scene import colmap, colmap_plain, colmap_records, undistort


@pytest.fixture(params=["pycolmap", "plain"])
def library(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """pycolmap, or ``colmap_plain`` in its place, as the package uses it in the test."""
    found = colmap_plain if request.param == "plain" else pytest.importorskip("pycolmap")
    for module in (colmap, colmap_records, undistort):
        monkeypatch.setattr(module, "pycolmap", found)
    return found
