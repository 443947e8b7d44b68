"""The synthetic city: number and values of its Gaussians, closed surfaces, and its files."""

from __future__ import annotations

from pathlib import Path

import city as made
import numpy as np
import pytest
import torch

from clod_adapter.io.checkpoint import load
from clod_adapter.io.scene.load import load_scene
from clod_adapter.metrics import psnr
from clod_adapter.render import render


@pytest.mark.parametrize(("count", "sh_degree"), [(1000, 0), (12_345, 3), (70_000, 0)])
def test_number_and_values_of_gaussians(count: int, sh_degree: int) -> None:
    g, same, other = (made.city(count, sh_degree=sh_degree, seed=seed) for seed in (0, 0, 1))
    assert (len(g), g.sh_degree) == (count, sh_degree)
    assert all(bool(tensor.isfinite().all()) for tensor in g.tensors().values())
    assert (g.quats.norm(dim=1) - 1).abs().max() < 1e-5
    assert all(torch.equal(a, b) for a, b in zip(g.tensors().values(), same.tensors().values(), strict=True))
    assert not torch.equal(g.means, other.means)


@pytest.mark.parametrize(("count", "where"), [(10_000, "near"), (100_000, "far"), (100_000, "near")])
def test_surfaces_are_opaque(count: int, where: made.Where) -> None:
    g = made.city(count)
    for camera in made.city_cameras(4, 96, 60, where=where, count=count):
        with torch.no_grad():
            alpha = render(g, camera).alpha
        assert float((alpha > 0.9).float().mean()) > 0.96, f"{camera.name}: {float(alpha.mean()):.3f}"


def test_more_gaussians_cover_a_larger_area() -> None:
    def nearest(count: int) -> float:
        """Median distance of a Gaussian's nearest neighbour on the houses."""
        from scipy.spatial import cKDTree

        means = made.city(count).means[: count - made.surrounding(count)].numpy()
        return float(np.median(cKDTree(means).query(means[::20], 2)[0][:, 1]))

    assert made.extent(270_000).prod() > 2 * made.extent(120_000).prod()
    assert nearest(270_000) == pytest.approx(nearest(120_000), rel=0.25)


def test_a_written_city_can_be_loaded_and_trained(tmp_path: Path) -> None:
    made.write_city(tmp_path / "city", 4000, 9, 64, 40)
    base, scene = load(tmp_path / "city" / "city.ply"), load_scene(tmp_path / "city")
    assert (len(base.gaussians), len(scene.train), len(scene.test), base.notes) == (4000, 7, 2, ())
    view = scene.train[0]
    with torch.no_grad():
        truth = render(made.city(4000), view.camera).image
        error, of_truth = psnr(render(base.gaussians, view.camera).image, view.image), psnr(truth, view.image)
    assert of_truth > 45 > 35 > error > 15
