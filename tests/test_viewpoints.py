"""One distance for each Gaussian over several cameras, and cameras that a file stores."""

from __future__ import annotations

import pytest
import torch

from clod_adapter.attenuation import normalized_distances
from clod_adapter.config import AttenuationConfig
from clod_adapter.viewpoints import typical_distance, viewpoint_of
from scenes import camera, gaussians, ring

CONFIG = AttenuationConfig(scene_distance=4.0)


def test_it_is_a_geometric_mean() -> None:
    means, cameras = gaussians(30, 0, 0).means, ring(3, 8, 6)
    logs = [normalized_distances(means, each, CONFIG).log() for each in cameras]
    torch.testing.assert_close(typical_distance(means, cameras, CONFIG), (sum(logs) / 3).exp())
    on_top = cameras[0].position.repeat(30, 1)  # of one camera, whose distance counts as 1e-6
    apart = (cameras[0].position - cameras[1].position).norm() / 4
    torch.testing.assert_close(typical_distance(on_top, cameras[:2], CONFIG), (1e-6 * apart).sqrt().expand(30))


def test_of_one_camera_it_is_that_ones_bit_for_bit() -> None:
    means = gaussians(30, 0, 0).means
    assert torch.equal(typical_distance(means, [camera()], CONFIG), normalized_distances(means, camera(), CONFIG))


@pytest.mark.parametrize("normalizer", ["scene", "quantile", "max"])
def test_a_viewpoint_stands_for_its_camera(normalizer: str) -> None:
    config = AttenuationConfig(scene_distance=4.0, normalizer=normalizer)
    means, cameras = gaussians(200, 0, 1).means, ring(3, 61, 45)
    places = [viewpoint_of(each, means, config) for each in cameras]
    want = typical_distance(means, cameras, config)
    torch.testing.assert_close(typical_distance(means, places, config), want, rtol=1e-5, atol=0)
    moved = [place.moved([1e6, -5e5, 3.0]) for place in places]
    back = [place.moved([-1e6, 5e5, -3.0]) for place in moved]
    torch.testing.assert_close(typical_distance(means, back, config), want, rtol=1e-5, atol=0)
