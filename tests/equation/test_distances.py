"""Normalised distances of a camera, the typical distance over cameras, and stored viewpoints."""

import pytest
import torch

from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.distances import normalized_distances, normalizing_distance, typical_distance, viewpoint_of
from scenes import camera, gaussians, ring

CONFIG = AttenuationConfig(scene_distance=4.0)


def test_the_typical_distance_is_a_geometric_mean() -> None:
    means, cameras = gaussians(30, 0, 0).means, ring(3, 8, 6)
    logs = [normalized_distances(means, each, CONFIG).log() for each in cameras]
    torch.testing.assert_close(typical_distance(means, cameras, CONFIG), (sum(logs) / 3).exp())
    alone = typical_distance(means, [camera()], CONFIG)  # of one camera: that one's, bit for bit
    assert torch.equal(alone, normalized_distances(means, camera(), CONFIG))
    on_top = cameras[0].position.repeat(30, 1)  # of one camera, whose distance counts as 1e-6
    apart = (cameras[0].position - cameras[1].position).norm() / 4
    torch.testing.assert_close(typical_distance(on_top, cameras[:2], CONFIG), (1e-6 * apart).sqrt().expand(30))


@pytest.mark.parametrize("normalizer", ["scene", "max"])
def test_a_viewpoint_is_equivalent_to_its_camera(normalizer: str) -> None:
    config = AttenuationConfig(scene_distance=4.0, normalizer=normalizer)
    means, cameras = gaussians(200, 0, 1).means, ring(3, 61, 45)
    places = [viewpoint_of(each, means, config) for each in cameras]
    want = typical_distance(means, cameras, config)
    torch.testing.assert_close(typical_distance(means, places, config), want, rtol=1e-5, atol=0)
    moved = [place.moved([1e6, -5e5, 3.0]) for place in places]
    back = [place.moved([-1e6, 5e5, -3.0]) for place in moved]
    torch.testing.assert_close(typical_distance(means, back, config), want, rtol=1e-5, atol=0)


def test_distances_are_divided_by_the_configured_normalizer() -> None:
    """At depth 1 of this camera at z = -2 the image is x in [-0.5, 0.5) and y in [-0.4, 0.4)."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = 2.0
    camera = Camera(viewmat, torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]), width=100, height=80)
    # Along the axis at distances 1..10, then one behind the camera, one outside the image, one too near.
    axis = torch.tensor([[0.0, 0.0, z - 2.0] for z in range(1, 11)])
    unseen = torch.tensor([[0.0, 0.0, -52.0], [30.0, 0.0, -1.0], [0.0, 0.0, -1.995]])
    means = torch.cat([axis, unseen])
    distances = (means - torch.tensor([0.0, 0.0, -2.0])).norm(dim=1)
    for kind, other, want in [("scene", {"scene_distance": 4.0}, 4.0), ("max", {}, 10.0)]:
        chosen = AttenuationConfig(normalizer=kind, **other)
        assert normalizing_distance(distances, means, camera, chosen).item() == want
        torch.testing.assert_close(normalized_distances(means, camera, chosen), distances / want)
        found = normalized_distances(camera.position[None].requires_grad_(), camera, chosen)
        assert found.tolist() == [0.0] and not found.requires_grad
        assert normalized_distances(torch.empty(0, 3), camera, chosen).shape == (0,)
    largest = AttenuationConfig(normalizer="max")
    assert normalizing_distance(distances[10:12], means[10:12], camera, largest).item() == 50.0
    for x, y, inside in [(-0.49, 0, True), (-0.51, 0, False), (0.49, 0, True), (0.51, 0, False), (0, 0.41, False)]:
        pair = torch.tensor([[0.0, 0.0, -1.0], [x, y, -1.0]])
        found = normalizing_distance(torch.tensor([1.0, 9.0]), pair, camera, largest)
        assert found.item() == (9.0 if inside else 1.0), (x, y)
