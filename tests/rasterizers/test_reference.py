"""The float64 reference against plain loops: scipy's rotations, mpmath's harmonics, finite differences of a pinhole."""

import math

import mpmath
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, ScreenFilter
from clod_adapter.rasterizers import reference
from oracle import BACKGROUND, Parameters
from scenes import camera, in_front, scene


def harmonics(direction: np.ndarray) -> np.ndarray:
    """sqrt(2) Im Y_lm for m < 0 and Re for m > 0, with the Condon-Shortley phase, in the order of l, then m."""
    polar, azimuth = np.arccos(direction[2]), np.arctan2(direction[1], direction[0])
    found = []
    for degree, m in ((at, m) for at in range(5) for m in range(-at, at + 1)):
        value = mpmath.fp.spherharm(degree, abs(m), polar, azimuth)
        found.append(value.real if m == 0 else math.sqrt(2) * (value.imag if m < 0 else value.real))
    return np.array(found)


def drawn(some: Parameters, view: Camera, screen_filter: ScreenFilter) -> tuple[np.ndarray, np.ndarray]:
    """Image and alpha, one Gaussian after another, those in front first."""
    world, K, eye = (x.double().numpy() for x in (view.viewmat, view.K, view.position))
    means, quats, scales, opacities, sh0, shN = (x.double().numpy() for x in some.values())
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    image, through = np.zeros((view.height, view.width, 3)), np.ones((view.height, view.width))
    ended = np.zeros_like(through, bool)

    def pixel(point: np.ndarray) -> np.ndarray:
        return (K @ point)[:2] / point[2]

    points = means @ world[:3, :3].T + world[:3, 3]
    for i in points[:, 2].argsort():
        steps = [(pixel(points[i] + h) - pixel(points[i] - h)) / 2e-6 for h in 1e-6 * np.eye(3)]
        rotation = Rotation.from_quat(quats[i, [1, 2, 3, 0]]).as_matrix()
        half = np.stack(steps, 1) @ world[:3, :3] @ rotation @ np.diag(scales[i])
        covariance = half @ half.T + screen_filter.variance * np.eye(2)
        shown = np.sqrt(np.linalg.det(half @ half.T) / np.linalg.det(covariance)) if screen_filter.compensate else 1
        offsets = np.stack([x, y], -1) - pixel(points[i])
        power = -0.5 * np.einsum("hwi,ij,hwj->hw", offsets, np.linalg.inv(covariance), offsets)
        alpha = np.minimum(opacities[i] * shown * np.exp(power), 0.999)
        alpha[alpha < 1 / 255] = 0
        ended |= through * (1 - alpha) <= 1e-4
        alpha[ended] = 0
        direction = means[i] - eye
        basis = harmonics(direction / np.linalg.norm(direction))[: 1 + len(shN[i])]
        color = np.maximum(0.5 + basis @ np.concatenate([sh0[i], shN[i]]), 0)
        image += (alpha * through)[..., None] * color
        through *= 1 - alpha
    return image + through[..., None] * BACKGROUND.double().numpy(), 1 - through


@pytest.mark.parametrize("screen_filter", [CLASSIC, ScreenFilter(variance=0.7, compensate=True)], ids=str)
def test_images_are_those_of_plain_loops(screen_filter: ScreenFilter) -> None:
    """Of 80 Gaussians within the picture; a part of its pixels ends."""
    view, some = camera(41, 31), scene(80, 4, 3, size=0.3)
    places = torch.rand(80, 3, generator=torch.Generator().manual_seed(0)) - torch.tensor([0.5, 0.5, -2.0])
    some["means"] = in_front(view, places * torch.cat([0.8 * places[:, 2:].expand(80, 2), torch.ones(80, 1)], 1))
    some["opacities"][::2] = 0.95
    want = drawn(some, view, screen_filter)
    twin = {name: value.double() for name, value in some.items()}
    found = reference.rasterize(**twin, camera=view, background=BACKGROUND.double(), screen_filter=screen_filter)
    for mine, expected in zip(found, want, strict=True):
        np.testing.assert_allclose(mine, expected, atol=1e-7)
    assert (want[1] > 0.999).any() and (want[1] < 0.99).any()
