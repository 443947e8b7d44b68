"""The errors of levels are lengths by which the picture seems shifted."""

import pytest
import torch

from clod_adapter import AttenuationConfig, Camera, Gaussians
from clod_adapter.calibration import Viewpoint
from clod_adapter.equation.distances import viewpoint_of
from clod_adapter.evaluation.level_errors import geometric_errors, looking
from clod_adapter.io.formats.tileset import ALLOWED
from scenes import gaussians

WIDTH, HEIGHT, FOCAL, DISTANCE = 96, 72, 90.0, 6.0


def smooth() -> Gaussians:
    """Wide Gaussians at one distance, so that a shift of the image is the same everywhere."""
    found = gaussians(40, 0, 3, size=0.3)
    means = found.means * torch.tensor([0.7, 0.5, 0.0]) + torch.tensor([0.0, 0.0, DISTANCE])
    return found.replace(means=means, opacity_logits=found.opacity_logits.clamp(-1, 2))


def view() -> Camera:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera(torch.eye(4), K, WIDTH, HEIGHT)


def test_a_shift_has_its_own_length() -> None:
    """Moved across by 0.4 pixels, seen from so far: pixels d / f, times what viewers allow."""
    finest, length = smooth(), 0.4 * DISTANCE / FOCAL
    moved = finest.replace(means=finest.means + torch.tensor([length, length, 0.0]) / 2**0.5)
    assert geometric_errors([finest, moved], [view()]) == pytest.approx([0, ALLOWED * length], rel=0.15)


def test_errors_ascend_and_grow_with_what_is_missing() -> None:
    """A level that happens to be nearer to the finest than the level before has that one's error."""
    finest = smooth()
    order = finest.opacity_logits.argsort(descending=True)
    half, few = finest[order[:20]], finest[order[:5]]
    errors = geometric_errors([finest, half, few, half], [view(), view()])
    assert 0 == errors[0] < errors[1] < errors[2] == errors[3]


def test_viewpoints_look_where_their_cameras_did() -> None:
    place = viewpoint_of(view(), smooth().means, AttenuationConfig())
    same, placed = looking([view(), place, Viewpoint(1.0, 2.0, -3.0, 1.0)])  # the last one has no direction
    assert torch.allclose(placed.viewmat, same.viewmat, atol=1e-6)
    assert placed.K[1, 1] / placed.height == pytest.approx(same.K[1, 1] / same.height)
