"""The synthetic city: any number of Gaussians, all usable, surfaces that are closed, and a scene that loads."""

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


@pytest.mark.parametrize("count", [1000, 12_345, 70_000])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_has_as_many_gaussians_as_asked_for_and_all_are_usable(count: int, sh_degree: int) -> None:
    g = made.city(count, sh_degree=sh_degree)
    assert (len(g), g.sh_degree) == (count, sh_degree)
    assert all(bool(tensor.isfinite().all()) for tensor in g.tensors().values())
    assert (g.quats.norm(dim=1) - 1).abs().max() < 1e-5


def test_is_the_same_for_a_seed_and_another_for_another() -> None:
    one, same, other = made.city(5000), made.city(5000), made.city(5000, seed=1)
    assert all(torch.equal(a, b) for a, b in zip(one.tensors().values(), same.tensors().values(), strict=True))
    assert not torch.equal(one.means, other.means)


@pytest.mark.parametrize("count", [10_000, 100_000])
@pytest.mark.parametrize("where", ["near", "far"])
def test_no_light_comes_through_what_is_seen(count: int, where: made.Where) -> None:
    g = made.city(count)
    for camera in made.city_cameras(4, 96, 60, where=where, count=count):
        with torch.no_grad():
            alpha = render(g, camera).alpha
        assert float((alpha > 0.9).float().mean()) > 0.96, f"{camera.name}: {float(alpha.mean()):.3f}"


def test_more_gaussians_are_more_city_and_not_a_denser_one() -> None:
    def nearest(count: int) -> float:
        """Median distance of a Gaussian's nearest neighbour on the houses."""
        from scipy.spatial import cKDTree

        means = made.city(count).means[: count - made.surrounding(count)].numpy()
        return float(np.median(cKDTree(means).query(means[::20], 2)[0][:, 1]))

    assert made.extent(270_000).prod() > 2 * made.extent(120_000).prod()
    assert nearest(270_000) == pytest.approx(nearest(120_000), rel=0.25)


def test_a_written_city_is_a_scene_and_a_checkpoint_that_has_something_to_learn(tmp_path: Path) -> None:
    made.write_city(tmp_path / "city", 4000, 9, 64, 40)
    base, scene = load(tmp_path / "city" / "city.ply"), load_scene(tmp_path / "city")
    assert (len(base.gaussians), len(scene.train), len(scene.test), base.notes) == (4000, 7, 2, ())
    view = scene.train[0]
    with torch.no_grad():
        truth = render(made.city(4000), view.camera).image
        error, of_truth = psnr(render(base.gaussians, view.camera).image, view.image), psnr(truth, view.image)
    assert of_truth > 45 > 35 > error > 15
