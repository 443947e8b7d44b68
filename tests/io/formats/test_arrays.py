from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from clod_adapter.cameras import Camera
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.formats.arrays import half_turn, logit, logits_of_bytes, normalized, sigmoid
from clod_adapter.render import render
from scenes import camera, gaussians


def test_activations() -> None:
    logits = np.array([-80, -3, 0, 3, 12, np.inf], np.float32)
    np.testing.assert_allclose(logit(sigmoid(logits)), logits, rtol=1e-9)
    assert sigmoid(np.float32([-np.inf]))[0] == 0
    levels = logits_of_bytes(np.arange(256))
    assert np.isfinite(levels).all() and np.array_equal(np.round(255 * sigmoid(levels)), np.arange(256))


@pytest.mark.parametrize(("degree", "axis"), [(4, "x"), (4, "z")])
def test_a_turned_scene_seen_by_a_turned_camera_gives_the_same_image(degree: int, axis: str) -> None:
    """Positions, rotations and every harmonic turn alike; a wrong sign in one shows."""
    g = gaussians(400, degree, 3, size=0.15)
    arrays = {name: tensor.numpy() for name, tensor in g.tensors().items()}
    turned = Gaussians(**{name: torch.from_numpy(array) for name, array in half_turn(arrays, axis).items()})
    view = camera()
    turn = torch.diag(torch.tensor([1.0, -1, -1, 1] if axis == "x" else [-1.0, -1, 1, 1]))
    same = render(turned, Camera(view.viewmat @ turn, view.K, view.width, view.height)).image
    torch.testing.assert_close(same, render(g, view).image, atol=2e-5, rtol=0)
    back = half_turn(half_turn(arrays, axis), axis)
    assert all(np.array_equal(back[name], array) for name, array in arrays.items())


def test_rotations_of_any_length() -> None:
    quats = np.float32([[1e-40, 0, 0, 0], [3e38, 3e38, 3e38, -3e38], [0, -2, 0, 0]])
    half = math.sqrt(0.25)
    np.testing.assert_allclose(normalized(quats), [[1, 0, 0, 0], [half, half, half, -half], [0, -1, 0, 0]], rtol=1e-6)
