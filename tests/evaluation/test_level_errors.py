"""``evaluation.level_errors``: what each level of a leaf changes in the image."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from clod_adapter.calibration import Viewpoint
from clod_adapter.cameras import Camera
from clod_adapter.evaluation.level_errors import FLOOR, coverage, geometric_errors, level_errors, looking
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.io.formats.lod_meta import Leaf
from clod_adapter.io.formats.tileset import ALLOWED
from clod_adapter.render import render
from scenes import gaussians

VIEWPOINTS = [Viewpoint(0.0, 0.0, -6.0, 1.0), Viewpoint(0.5, 0.2, -6.0, 1.0)]


def balls(*centres: tuple[float, float, float], opacity: float = 0.9) -> Gaussians:
    """White balls of standard deviation 0.3."""
    n = len(centres)
    return Gaussians(
        torch.tensor(centres).float(), torch.tensor([[1.0, 0, 0, 0]] * n), torch.full((n, 3), 0.3).log(),
        torch.full((n,), opacity).logit(), torch.full((n, 1, 3), 0.5 / SH_C0), torch.empty(n, 0, 3),
    )  # fmt: skip


@pytest.fixture
def cameras() -> list[Camera]:
    return looking(VIEWPOINTS, balls((0, 0, 0)))


def leaf(x: float, z: float, *rows: list[int]) -> Leaf:
    """A leaf of half width 1 at (x, 0, z); it lacks the levels without rows."""
    lods = {str(level): {"count": len(each)} for level, each in enumerate(rows) if each}
    bound = {"min": [x - 1, -1, z - 1], "max": [x + 1, 1, z + 1]}
    return Leaf({"bound": bound, "lods": lods}, tuple(np.array(each, np.int64) for each in rows))


def test_coverage(cameras: list[Camera]) -> None:
    assert coverage(leaf(0, -6, [0]), cameras[0]) == 1
    assert coverage(leaf(0, 0, [0]), cameras[0]) == pytest.approx((3**0.5 / (3**0.5 + 5)) ** 2)


def test_errors_are_of_the_image(cameras: list[Camera]) -> None:
    """A step that changes nothing has only the share by counts, one that removes what is seen has more."""
    finest = balls((-2, 0, 0), (-2, 0.5, 0), (2, 0, 0), (2, 0.5, 0))
    coarse = balls((-2, 0, 0), (2, 0, 0)), balls((-2, 0, 0))
    finest = finest.replace(opacity_logits=torch.tensor([2.0, -20, 2, 2]))
    left, right = leaf(-2, 0, [0, 1], [0], [0]), leaf(2, 0, [2, 3], [1], [])
    same, less = level_errors([finest, *coarse], [left, right], cameras)
    assert same[0] == less[0] == 0 and same[1] == same[2] > 0 and less[2] == 0
    assert less[1] > 50 * same[1]  # FLOOR of it, at equal counts


def test_errors_are_the_sum_over_cameras_per_coverage(cameras: list[Camera]) -> None:
    """One leaf and two levels, rendered as they are."""
    levels = [balls((0, 0, 0), (0.5, 0, 0)), balls((0, 0, 0))]
    only = leaf(0, 0, [0, 1], [0])
    finest, coarse = ([render(level, camera).image.clamp(0, 1) for camera in cameras] for level in levels)
    squares = sum(float((a - b).square().mean()) for a, b in zip(finest, coarse, strict=True))
    energy = sum(float(image.square().mean()) for image in finest) / len(cameras)
    want = squares / sum(coverage(only, camera) for camera in cameras) / energy
    ((none, found),) = level_errors(levels, [only], cameras)
    assert none == 0 and found == pytest.approx((1 + FLOOR) * want, rel=1e-3)


def test_unseen_leaves_keep_the_order_of_their_counts(cameras: list[Camera]) -> None:
    """A viewer steps to finer levels only where they have less error."""
    levels = [balls((0, 0, 0), (0.5, 0, 0), (0, 0, -20), (0, 0, -20)), balls((0, 0, 0), (0, 0, -20))]
    seen, unseen = level_errors(levels, [leaf(0, 0, [0, 1], [0]), leaf(0, -20, [2, 3], [1])], cameras)
    assert unseen[0] == 0 and unseen[1] == pytest.approx(FLOOR / 2 * (seen[1] - unseen[1]))


def test_a_leaf_without_the_finest_level_is_compared_with_the_finest_it_has(cameras: list[Camera]) -> None:
    levels = [balls((1, 0, 0)), balls((1, 0, 0), (0, 0, 0), (0.5, 0, 0)), balls((1, 0, 0), (0, 0, 0))]
    other, found = level_errors(levels, [leaf(1, 0, [0], [0], [0]), leaf(0, 0, [], [1, 2], [1])], cameras)
    assert (other == 0).all() and (found[:2] == 0).all() and found[2] > 0


WIDTH, HEIGHT, FOCAL, DISTANCE = 96, 72, 90.0, 6.0


def smooth() -> Gaussians:
    """Wide Gaussians at one distance, so that a shift of the image is the same everywhere."""
    found = gaussians(40, 0, 3, size=0.3)
    means = found.means * torch.tensor([0.7, 0.5, 0.0]) + torch.tensor([0.0, 0.0, DISTANCE])
    return found.replace(means=means, opacity_logits=found.opacity_logits.clamp(-1, 2))


def view() -> Camera:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera(torch.eye(4), K, WIDTH, HEIGHT)


@pytest.mark.parametrize("pixels", [0.25, 0.5])
def test_a_shift_has_its_own_length(pixels: float) -> None:
    """Moved across by so many pixels, seen from so far: pixels d / f, times what viewers allow."""
    finest = smooth()
    length = pixels * DISTANCE / FOCAL
    moved = finest.replace(means=finest.means + torch.tensor([length, length, 0.0]) / 2**0.5)
    errors = geometric_errors([finest, moved], [view()])
    assert errors[0] == 0
    assert errors[1] == pytest.approx(ALLOWED * length, rel=0.15)


def test_errors_ascend_and_grow_with_what_is_missing() -> None:
    """A level that happens to be nearer to the finest than the level before has that one's error."""
    finest = smooth()
    order = finest.opacity_logits.argsort(descending=True)
    half, few = finest[order[:20]], finest[order[:5]]
    errors = geometric_errors([finest, half, few, half], [view(), view()])
    assert 0 == errors[0] < errors[1] < errors[2] == errors[3]
