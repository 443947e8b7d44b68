"""A dial without settings: a note with the share that it keeps, a warning where that is too small."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from clod_adapter.adapter import with_dial
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.extinction import sigma_for_extinction
from clod_adapter.equation.units import estimated_distance
from clod_adapter.inspection.report import inspect
from clod_adapter.io.checkpoint import load, save
from formats import without_comments
from scenes import gaussians


@pytest.mark.parametrize(
    ("factor", "begin", "parts"),
    [
        (1.0, "its dial is not", ["world units, tau 0.02, soft cut: keeps 60% at s = 1"]),
        (0.05, "warning: ", ["keeps 0% at s = 1", "likely not what was adapted"]),
    ],
)
def test_file_without_settings_has_a_note(tmp_path: Path, factor: float, begin: str, parts: list[str]) -> None:
    """The file keeps six tenths at s = 1 from its reference distance; sigma_d is multiplied by ``factor``."""
    config, path, some = AttenuationConfig(), tmp_path / "a.ply", gaussians(500, 0, 1)
    some = some.replace(means=10 * some.means, opacity_logits=some.opacity_logits.clamp(min=-2))
    d = torch.full((500,), estimated_distance(some.means))
    sigma = sigma_for_extinction(some.opacity_logits, d, torch.linspace(0.5, 1.75, 500), config)
    save(path, with_dial(some, factor * sigma, config))
    assert load(path).notes == () and inspect(path).notes == ()
    base = load(without_comments(path))
    assert base.gaussians.attenuation == config
    for notes in (base.notes, inspect(path.with_name("rewritten.ply")).notes):
        (note,) = notes
        assert note.startswith(begin) and all(part in note for part in parts)
