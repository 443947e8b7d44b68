"""What files are silent on: those of earlier versions are read as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from clod_adapter.config import AttenuationConfig
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.formats.metadata import read_card
from clod_adapter.io.ply.columns import inria_dtype
from clod_adapter.io.settings import BEFORE, as_before, with_range

# As an earlier version wrote them.
HEADER = """version 0.1.0
tau 0.02
cut soft
eps 1e-08
normalizer scene
quantile 0.95
scene_distance 9.894437842071056
max_sv 5.0"""


def written(path: Path, comments: list[str]) -> Path:
    rng = np.random.default_rng(0)
    rows = np.zeros(50, [*inria_dtype(0).descr, ("sigma_d", "<f4")])
    for name in rows.dtype.names:
        rows[name] = rng.normal(size=50)
    lines = [f"clod_adapter {comment}" for comment in comments]
    PlyData([PlyElement.describe(rows, "vertex", comments=lines)], byte_order="<").write(str(path))
    return path


def test_a_header_of_an_earlier_version_is_read_as_before(tmp_path: Path) -> None:
    path = written(tmp_path / "a.ply", HEADER.splitlines())
    checkpoint = load(path)
    assert checkpoint.gaussians.attenuation == AttenuationConfig(
        tau=0.02, cut="soft", scene_distance=9.894437842071056, reference_distance=9.894437842071056
    )
    raw = PlyData.read(str(path))["vertex"]["sigma_d"]
    assert checkpoint.notes == () and checkpoint.gaussians.sigma_d.numpy().tobytes() == raw.tobytes()
    save(tmp_path / "b.ply", checkpoint.gaussians, checkpoint)  # and written as this version does
    again = load(tmp_path / "b.ply").gaussians
    assert again.attenuation == AttenuationConfig(reference_distance=9.894437842071056)
    positive = raw > 0
    np.testing.assert_allclose(again.sigma_d.numpy()[positive], 9.894437842071056 * raw[positive], rtol=1e-5)


def test_a_header_that_is_silent_has_the_defaults_of_then(tmp_path: Path) -> None:
    checkpoint = load(written(tmp_path / "a.ply", ["max_sv 3.0"]))
    assert checkpoint.gaussians.attenuation == AttenuationConfig(
        tau=1 / 255, cut="hard", eps=1e-8, normalizer="scene", scene_distance=1.0, reference_distance=1.0, max_sv=3.0
    )
    (note,) = checkpoint.notes
    assert "earlier versions: tau, cut, eps, normalizer, quantile, scene_distance" in note


def test_a_description_of_an_earlier_version_is_read_as_before(tmp_path: Path) -> None:
    about = {"format": "clod-model", "format_version": 1, "package_version": "0.1.0"}
    card, notes = read_card(tmp_path, about | {"attenuation": BEFORE | {"scene_distance": 3.5}}, 1)
    assert card.attenuation == AttenuationConfig(**BEFORE | {"scene_distance": 3.5, "reference_distance": 3.5})
    assert notes == []


def test_nothing_is_said_of_what_is_there() -> None:
    assert as_before(BEFORE) == ({**BEFORE, "reference_distance": 1.0}, [])


@pytest.mark.parametrize("tau", [0.02, 0.19, 0.2, 0.5, 0.98])
def test_an_unknown_range_fits_the_tau(tau: float) -> None:
    found = with_range({"tau": tau})
    assert found.tau == tau and found.max_sv >= 1 and (found.max_sv == 5) == (tau < 0.2)
