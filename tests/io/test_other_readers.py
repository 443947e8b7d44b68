"""Files exchanged with gsply and splat-transform."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from clod_adapter.adapter import detach
from clod_adapter.config import AttenuationConfig
from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import write
from formats import covariances, model, splat_transform, turned


@pytest.mark.parametrize(
    ("suffix", "degree", "atol"), [(".ply", 0, 0.0), (".ply", 2, 0.0), (".ply", 3, 0.0), (".spz", 3, 1e-5)]
)
def test_gsply_reads_files(tmp_path: Path, suffix: str, degree: int, atol: float) -> None:
    gsply = pytest.importorskip("gsply.spz", reason="gsply is not installed")
    path = tmp_path / f"a{suffix}"
    write(path, model(degree))
    found, ours = (gsply.read_spz if atol else __import__("gsply").plyread)(path), load(path).gaussians
    for name, want in (("means", ours.means), ("scales", ours.log_scales), ("sh0", ours.sh0[:, 0])):
        np.testing.assert_allclose(getattr(found, name), want, atol=atol, rtol=0)
    assert turned(torch.from_numpy(found.quats), ours.quats) <= 100 * atol
    if degree:
        np.testing.assert_allclose(found.shN, ours.shN, atol=atol, rtol=0)
    opacities = 1 / (1 + np.exp(-found.opacities.ravel().astype(np.float64)))
    np.testing.assert_allclose(opacities, ours.opacities, atol=max(110 * atol, 1e-6))


def test_files_of_gsply_are_read(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="gsply is not installed")
    g = model(3)
    arrays = {name: tensor.numpy() for name, tensor in g.tensors().items()}
    rest = {"scales": arrays["log_scales"], "opacities": arrays["opacity_logits"].clip(max=20), "shN": arrays["shN"]}
    data = gsply.GSData(means=arrays["means"], quats=arrays["quats"], sh0=arrays["sh0"][:, 0], **rest)
    gsply.plywrite(tmp_path / "a.ply", data)
    again = load(tmp_path / "a.ply").gaussians
    assert torch.equal(again.means, g.means) and torch.equal(again.shN, g.shN)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".splat"])
def test_splat_transform_reads_files(tmp_path: Path, suffix: str) -> None:
    """It keeps the dial's columns of a PLY bit for bit and in order, but drops the comments with the settings."""
    write(tmp_path / f"a{suffix}", detach(model(0)) if suffix == ".splat" else model(3))
    splat_transform(tmp_path / f"a{suffix}", tmp_path / "b.ply")
    ours, found = load(tmp_path / f"a{suffix}").gaussians, load(tmp_path / "b.ply")
    theirs, atol = found.gaussians, 0.0 if suffix == ".ply" else 1e-5
    for name in ("means", "sh0", "shN"):
        torch.testing.assert_close(getattr(theirs, name), getattr(ours, name), atol=atol, rtol=0)
    if suffix == ".splat":
        assert turned(theirs.quats, ours.quats) < 0.02
    else:
        torch.testing.assert_close(covariances(theirs), covariances(ours), atol=1e-6, rtol=1e-3)
    # 1.1e-3: the levels 0 and 255 are read as a quarter of a level inside.
    torch.testing.assert_close(theirs.opacities, ours.opacities, atol=1.1e-3, rtol=0)
    if suffix == ".ply":
        for name in ("sigma_d", "growth_d"):
            assert torch.equal(getattr(theirs, name), getattr(ours, name))
        assert theirs.attenuation == AttenuationConfig(reference_distance=3.217)
        assert any("its dial is not described" in note for note in found.notes)
