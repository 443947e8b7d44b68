from __future__ import annotations

import numpy as np
import pytest
import torch

from clod_adapter.cameras import Camera
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.values import half_turn
from clod_adapter.render import render
from scenes import camera, gaussians


@pytest.mark.parametrize(("degree", "axis"), [(4, "x"), (4, "z")])
def test_half_turn_of_scene_and_camera_keeps_the_image(degree: int, axis: str) -> None:
    """Of positions, rotations and harmonics; a wrong sign in one changes the image."""
    g = gaussians(400, degree, 3, size=0.15)
    arrays = {name: tensor.numpy() for name, tensor in g.tensors().items()}
    turned = Gaussians(**{name: torch.from_numpy(array) for name, array in half_turn(arrays, axis).items()})
    view = camera()
    turn = torch.diag(torch.tensor([1.0, -1, -1, 1] if axis == "x" else [-1.0, -1, 1, 1]))
    same = render(turned, Camera(view.viewmat @ turn, view.K, view.width, view.height)).image
    torch.testing.assert_close(same, render(g, view).image, atol=2e-5, rtol=0)
    back = half_turn(half_turn(arrays, axis), axis)
    assert all(np.array_equal(back[name], array) for name, array in arrays.items())
