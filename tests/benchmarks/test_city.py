"""The synthetic town: its Gaussians, closed surfaces, and files that can be trained."""

from pathlib import Path

import city as made
import torch

from clod_adapter.io.checkpoint import load
from clod_adapter.io.scene.load import load_scene
from clod_adapter.metrics import psnr
from clod_adapter.render import render


def test_surfaces_are_opaque() -> None:
    g, same = made.city(70_000, sh_degree=3), made.city(70_000, sh_degree=3)
    assert (len(g), g.sh_degree) == (70_000, 3)
    assert all(torch.equal(a, b) for a, b in zip(g.tensors().values(), same.tensors().values(), strict=True))
    for camera in made.city_cameras(4, 96, 60, where="far", count=70_000):
        with torch.no_grad():
            alpha = render(g, camera).alpha
        assert float((alpha > 0.9).float().mean()) > 0.9, f"{camera.name}: {float(alpha.mean()):.3f}"


def test_a_written_town_can_be_loaded_and_trained(tmp_path: Path) -> None:
    made.write_city(tmp_path / "city", 4000, 9, 64, 40)
    base, scene = load(tmp_path / "city" / "city.ply"), load_scene(tmp_path / "city")
    assert (len(base.gaussians), len(scene.train), len(scene.test), base.notes) == (4000, 7, 2, ())
    view = scene.train[0]
    with torch.no_grad():
        truth = render(made.city(4000), view.camera).image
        error, of_truth = psnr(render(base.gaussians, view.camera).image, view.image), psnr(truth, view.image)
    assert of_truth > 45 > 35 > error > 15
