"""The extended PLY in readers that are not ours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from clod_adapter.config import AttenuationConfig
from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import write
from formats import model, splat_transform


@pytest.mark.parametrize("degree", range(4))
def test_gsply_reads_it_and_drops_sigma_d(tmp_path: Path, degree: int) -> None:
    gsply = pytest.importorskip("gsply", reason="gsply is not installed")
    g = model(degree)
    write(tmp_path / "a.ply", g)
    found = gsply.plyread(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.means, g.means)
    np.testing.assert_array_equal(found.quats, g.quats)
    np.testing.assert_array_equal(found.scales, g.log_scales)
    np.testing.assert_array_equal(found.opacities[1:], g.opacity_logits[1:])
    np.testing.assert_array_equal(found.sh0, g.sh0[:, 0])
    if degree:
        np.testing.assert_array_equal(found.shN, g.shN)


def test_what_gsply_writes(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="gsply is not installed")
    g = model(3)
    arrays = {name: tensor.numpy() for name, tensor in g.tensors().items()}
    rest = {"scales": arrays["log_scales"], "opacities": arrays["opacity_logits"].clip(max=20), "shN": arrays["shN"]}
    data = gsply.GSData(means=arrays["means"], quats=arrays["quats"], sh0=arrays["sh0"][:, 0], **rest)
    gsply.plywrite(tmp_path / "a.ply", data)
    again = load(tmp_path / "a.ply").gaussians
    assert torch.equal(again.means, g.means) and torch.equal(again.shN, g.shN)


def test_splat_transform_keeps_sigma_d(tmp_path: Path) -> None:
    """Bit for bit and in order; the header's comments, and with them the settings, are lost."""
    g = model(3)
    write(tmp_path / "a.ply", g)
    splat_transform(tmp_path / "a.ply", tmp_path / "b.ply")
    again = load(tmp_path / "b.ply")
    assert again.gaussians.sigma_d is not None and torch.equal(again.gaussians.sigma_d, g.sigma_d)
    assert torch.equal(again.gaussians.means, g.means) and torch.equal(again.gaussians.shN, g.shN)
    assert again.gaussians.attenuation == AttenuationConfig() and "its dial is not described" in again.notes[0]
