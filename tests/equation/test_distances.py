"""Normalised distances of a camera, the typical distance over cameras, stored viewpoints, and the
unit of sigma_d.
"""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clod_adapter import AttenuationConfig, Camera, with_dial
from clod_adapter.cameras import intrinsics
from clod_adapter.config import FORMS
from clod_adapter.equation import units
from clod_adapter.equation.attenuation import SIGMA_MAX, dial
from clod_adapter.equation.distances import (
    normalized_distances,
    normalizing_distance,
    typical_distance,
    viewpoint_of,
)
from clod_adapter.equation.units import in_world_units, nominal_distance, with_distance
from scenes import camera, gaussians, ring

CONFIG, PAPER = AttenuationConfig(scene_distance=4.0), AttenuationConfig(form="paper")


def test_the_typical_distance_is_a_geometric_mean():
    means, cameras = gaussians(30, 0, 0).means, ring(3, 8, 6)
    logs = [normalized_distances(means, each, CONFIG).log() for each in cameras]
    torch.testing.assert_close(typical_distance(means, cameras, CONFIG), (sum(logs) / 3).exp())
    alone = typical_distance(means, [camera()], CONFIG)  # of one camera: that one's, bit for bit
    assert torch.equal(alone, normalized_distances(means, camera(), CONFIG))
    on_top = cameras[0].position.repeat(30, 1)  # of one camera, whose distance counts as 1e-6
    apart = (cameras[0].position - cameras[1].position).norm() / 4
    torch.testing.assert_close(
        typical_distance(on_top, cameras[:2], CONFIG), (1e-6 * apart).sqrt().expand(30)
    )


@pytest.mark.parametrize("form", FORMS)
def test_a_viewpoint_is_equivalent_to_its_camera(form):
    config = AttenuationConfig(scene_distance=4.0, form=form)
    means, cameras = gaussians(200, 0, 1).means, ring(3, 61, 45)
    places = [viewpoint_of(each, means, config) for each in cameras]
    want = typical_distance(means, cameras, config)
    torch.testing.assert_close(typical_distance(means, places, config), want, rtol=1e-5, atol=0)
    moved = [place.moved([1e6, -5e5, 3.0]) for place in places]
    back = [place.moved([-1e6, 5e5, -3.0]) for place in moved]
    torch.testing.assert_close(typical_distance(means, back, config), want, rtol=1e-5, atol=0)


def test_distances_are_divided_by_the_unit_of_the_form():
    """At depth 1 of this camera at z = -2 the image is x in [-0.5, 0.5) and y in [-0.4, 0.4)."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = 2.0
    camera = Camera(viewmat, intrinsics(100.0, 100, 50, 40), width=100, height=80)
    # Along the axis at distances 1..10, then one behind the camera, one outside the image, one too
    # near.
    axis = torch.tensor([[0.0, 0.0, z - 2.0] for z in range(1, 11)])
    unseen = torch.tensor([[0.0, 0.0, -52.0], [30.0, 0.0, -1.0], [0.0, 0.0, -1.995]])
    means = torch.cat([axis, unseen])
    distances = (means - torch.tensor([0.0, 0.0, -2.0])).norm(dim=1)
    for chosen, want in ((CONFIG, 4.0), (PAPER, 10.0)):
        assert normalizing_distance(distances, means, camera, chosen).item() == want
        torch.testing.assert_close(normalized_distances(means, camera, chosen), distances / want)
        found = normalized_distances(camera.position[None].requires_grad_(), camera, chosen)
        assert found.tolist() == [0.0] and not found.requires_grad
        assert normalized_distances(torch.empty(0, 3), camera, chosen).shape == (0,)
    assert normalizing_distance(distances[10:12], means[10:12], camera, PAPER).item() == 50.0
    for x, y, inside in [
        (-0.49, 0, True),
        (-0.51, 0, False),
        (0.49, 0, True),
        (0.51, 0, False),
        (0, 0.41, False),
    ]:
        pair = torch.tensor([[0.0, 0.0, -1.0], [x, y, -1.0]])
        found = normalizing_distance(torch.tensor([1.0, 9.0]), pair, camera, PAPER)
        assert found.item() == (9.0 if inside else 1.0), (x, y)


@settings(deadline=None, max_examples=30)
@given(st.floats(1e-6, 1e6), st.floats(1, 20), st.sampled_from(FORMS), st.sampled_from([0.0, 2.5]))
def test_changing_the_unit_keeps_the_dial(distance, s, form, known):
    config = AttenuationConfig(form=form, scene_distance=3.7, max_sv=20.0, reference_distance=known)
    some = with_dial(gaussians(400, 0, 3), torch.logspace(-2, 2, 400), config)
    some = some.replace(
        sigma_d=some.sigma_d.double(),
        means=some.means.double(),
        growth_d=torch.linspace(-1, 3, 400),
    )
    other = with_distance(some, distance)
    assert other.attenuation.scene_distance == distance
    assert units.known_distance(other.attenuation) == (known or 3.7)
    found, want = (dial(each, camera(), s) for each in (other, some))
    torch.testing.assert_close(found.drawn, want.drawn, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found.growth, want.growth, rtol=1e-5, atol=0)
    assert torch.equal(other.sigma_d, some.sigma_d) == (form == "paper" or distance == 3.7)
    torch.testing.assert_close(with_distance(other, 3.7).sigma_d, some.sigma_d, rtol=1e-15, atol=0)


def test_what_stands_for_infinity_keeps_its_sigma():
    sigma = torch.tensor([0.0, -1.0, SIGMA_MAX, 2.0, 9e8, math.inf])
    some = with_dial(gaussians(6, 0, 0), sigma, AttenuationConfig(scene_distance=8.0))
    there = in_world_units(some)
    assert there.sigma_d.tolist() == [
        0.0,
        -8.0,
        SIGMA_MAX,
        16.0,
        SIGMA_MAX,
        math.inf,
    ]
    assert in_world_units(there) is there and in_world_units(gaussians(4, 0, 0)).attenuation is None
    assert there.attenuation == AttenuationConfig(reference_distance=8.0)


def test_nominal_distance_is_that_of_the_training_views():
    means = gaussians(500, 0, 1).means
    config = AttenuationConfig()
    assert nominal_distance(means, config) == units.estimated_distance(means)
    assert nominal_distance(means, replace(config, reference_distance=2.5)) == 2.5
    # as earlier versions wrote
    assert nominal_distance(means, replace(config, scene_distance=4.0)) == 1.0
    assert (
        nominal_distance(means, replace(config, scene_distance=4.0, reference_distance=2.0)) == 0.5
    )
    assert nominal_distance(means, replace(PAPER, reference_distance=2.5)) == 1.0
