"""Normalised distances of a camera, the typical distance over cameras, stored viewpoints, and the unit of sigma_d."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clod_adapter import AttenuationConfig, Camera, Gaussians, with_dial
from clod_adapter.equation import units
from clod_adapter.equation.attenuation import SIGMA_MAX, dial
from clod_adapter.equation.distances import normalized_distances, normalizing_distance, typical_distance, viewpoint_of
from clod_adapter.equation.units import in_world_units, nominal_distance, with_distance
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


def dialled(n: int = 400, **config: float | str) -> Gaussians:
    some = gaussians(n, 0, 3)
    sigma = torch.logspace(-2, 2, n)
    return with_dial(some, sigma, AttenuationConfig(**({"scene_distance": 3.7} | config)))  # type: ignore[arg-type]


@settings(deadline=None, max_examples=30)
@given(
    st.floats(1e-3, 1e4), st.sampled_from([0.0, 1e-8, 0.3]), st.floats(1, 20),
    st.sampled_from(["scene", "max"]), st.sampled_from([0.0, 2.5]),
)  # fmt: skip
def test_changing_the_unit_keeps_the_dial(distance: float, eps: float, s: float, normalizer: str, known: float) -> None:
    some = dialled(eps=eps, max_sv=20.0, normalizer=normalizer, reference_distance=known)
    some = some.replace(sigma_d=some.sigma_d.double(), means=some.means.double(), growth_d=torch.linspace(-1, 3, 400))
    other = with_distance(some, distance)
    assert other.attenuation is not None and other.attenuation.scene_distance == distance
    assert units.known_distance(other.attenuation) == (known or 3.7)
    found, want = (dial(each, camera(), s) for each in (other, some))
    # Where the unit grows a little, eps alone may fade less than a tiny sigma did: sigma' would have to be imaginary.
    possible = other.sigma_d > 0
    assert eps > 1e-6 or possible[some.sigma_d > 0.01].all()
    torch.testing.assert_close(found.log_opacities[possible], want.log_opacities[possible], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(found.growth, want.growth, rtol=1e-5, atol=0)
    assert torch.equal(in_world_units(other).sigma_d, other.sigma_d) == (normalizer != "scene" or distance == 1)


def test_special_values_and_other_normalizers_keep_sigma() -> None:
    sigma = torch.tensor([0.0, -1.0, SIGMA_MAX, 2.0])
    some = with_dial(gaussians(4, 0, 0), sigma, AttenuationConfig(scene_distance=8.0))
    there = in_world_units(some)
    assert there.sigma_d is not None and there.sigma_d[:3].tolist() == [0.0, -1.0, SIGMA_MAX]
    assert there.sigma_d[3].item() == pytest.approx(16.0)
    assert in_world_units(there) is there and in_world_units(gaussians(4, 0, 0)).attenuation is None
    assert there.attenuation == AttenuationConfig(reference_distance=8.0)


def test_nominal_distance_is_that_of_the_training_views() -> None:
    means = gaussians(500, 0, 1).means
    config = AttenuationConfig()
    assert nominal_distance(means, config) == units.estimated_distance(means)
    assert nominal_distance(means, replace(config, reference_distance=2.5)) == 2.5
    assert nominal_distance(means, replace(config, scene_distance=4.0)) == 1.0  # as earlier versions wrote
    assert nominal_distance(means, replace(config, scene_distance=4.0, reference_distance=2.0)) == 0.5
    assert nominal_distance(means, replace(config, normalizer="max", reference_distance=2.5)) == 1.0


@pytest.mark.parametrize("typical", [1e-4, 0.006, 3.0, 4.2e5])
def test_eps_is_stable_over_repeated_training(typical: float) -> None:
    some = dialled(scene_distance=typical)
    there = in_world_units(some)
    torch.testing.assert_close(there.sigma_d, typical * some.sigma_d, rtol=1e-4, atol=1e-6 * typical)
    torch.testing.assert_close(with_distance(there, typical).sigma_d, some.sigma_d, rtol=1e-4, atol=1e-6)
    again = there
    for _ in range(4):  # as one training after the other has it
        again = in_world_units(with_distance(again, typical))
    assert there.attenuation is not None and again.attenuation is not None
    assert again.attenuation.eps == pytest.approx(there.attenuation.eps, rel=1e-3)
    assert typical < 0.01 or again.attenuation.eps == there.attenuation.eps == 1e-8
    assert typical > 1e-4 or there.attenuation.eps == 1e-16
    torch.testing.assert_close(again.sigma_d, there.sigma_d, rtol=1e-4, atol=1e-6)
