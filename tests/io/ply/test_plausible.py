"""A dial that nothing describes: a note with what its reading keeps, a warning where that is too little."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from plyfile import PlyData, PlyElement

from clod_adapter.adapter import attach
from clod_adapter.config import AttenuationConfig
from clod_adapter.extinction import sigma_for_extinction
from clod_adapter.inspection.report import inspect
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.ply.plausible import check_plausible
from clod_adapter.units import estimated_distance
from scenes import gaussians


def undescribed(path: Path, factor: float = 1.0, config: AttenuationConfig | None = None) -> Path:
    """A file that keeps six tenths at s = 1 from its typical distance, sigma_d times ``factor``, without comments."""
    config = config or AttenuationConfig()
    some = gaussians(500, 0, 1)
    some = some.replace(means=10 * some.means, opacity_logits=some.opacity_logits.clamp(min=-2))
    d = torch.full((500,), estimated_distance(some.means))
    leaves = torch.linspace(0.5, 1.75, 500)
    sigma = sigma_for_extinction(some.opacity_logits, d, leaves, config)
    save(path, attach(some, factor * sigma, config))
    rows = PlyData.read(str(path))["vertex"].data
    rewritten = path.with_name("rewritten.ply")
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(rewritten))
    return rewritten


def test_a_plausible_reading_is_noted_with_its_number(tmp_path: Path) -> None:
    path = undescribed(tmp_path / "a.ply")
    for notes in (load(path).notes, inspect(path).notes):
        (note,) = notes
        assert not note.startswith("warning") and "world units, tau 0.02, soft cut: keeps 60% at s = 1" in note


def test_a_sigma_in_other_units_is_warned_of_with_its_number(tmp_path: Path) -> None:
    path = undescribed(tmp_path / "a.ply", factor=0.05)
    for notes in (load(path).notes, inspect(path).notes):
        (note,) = notes
        assert note.startswith("warning: ") and "keeps 0% at s = 1" in note and "likely not what was adapted" in note


def test_a_file_that_says_how_it_is_read_is_not_check_plausibled(tmp_path: Path) -> None:
    undescribed(tmp_path / "a.ply", factor=0.05)
    assert load(tmp_path / "a.ply").notes == () and inspect(tmp_path / "a.ply").notes == ()


@pytest.mark.parametrize("normalizer", ["max", "quantile"])
def test_no_scale_changes_the_other_normalisers(normalizer: str) -> None:
    config = AttenuationConfig(normalizer=normalizer)
    some = gaussians(20, 0, 0)
    assert check_plausible(some.means, some.opacity_logits, torch.full((20,), 1e-6), config) == []
