"""The measure of popping separates a jump from a fade and excludes the camera's motion."""

import dataclasses
import math
from itertools import product

import pytest
import torch

from clod_adapter import AdaptConfig, AttenuationConfig, Camera, Gaussians, render, with_dial
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.extinction import sigma_for_extinction
from clod_adapter.evaluation.popping import dial_popping, path, path_popping, sweep
from scenes import gaussians, ring


def dialled(tau: float = 1 / 255, n: int = 200, **settings: object) -> Gaussians:
    """Gaussians that fade at different dial values; scene distance 4, where the ring of cameras is."""
    sigma = torch.linspace(0.3, 4, n)[torch.randperm(n, generator=torch.Generator().manual_seed(3))]
    config = AttenuationConfig(**({"tau": tau, "cut": "hard", "scene_distance": 4.0} | settings))
    return with_dial(gaussians(n, 1, 0, size=0.2), sigma, config)


def test_popping_of_a_fade_and_of_a_switch() -> None:
    """Grey rising by 1/100 a step on one of two pixels; and black that becomes grey 1/2 in one step."""
    positions = [k / 10 for k in range(11)]
    fade = sweep(lambda _, j: torch.tensor([[[j / 100] * 3, [0.0] * 3]]), positions)
    assert fade.steps == 10 and fade.mean == pytest.approx(2.55 / math.sqrt(2), rel=1e-4)
    assert fade.ratio == pytest.approx(1, abs=1e-4) and fade.persistence == pytest.approx(0.5, abs=1e-4)
    assert fade.pixel == pytest.approx(2.55, rel=1e-4) and fade.pixel_persistence == pytest.approx(0.5, abs=1e-4)
    switch = sweep(lambda _, j: torch.full((1, 2, 3), 0.5 * (j >= 4)), positions)
    assert switch.largest == switch.pixel == 127.5 and switch.at == switch.pixel_at == 0.4
    assert switch.ratio == pytest.approx(10) and switch.persistence == switch.pixel_persistence == 1
    assert list(switch.changes) == [0, 0, 0, 127.5, *[0] * 6]
    # There and back at every step: over two steps nothing is left, which must not make it a fade.
    flicker = sweep(lambda _, j: torch.full((1, 1, 3), 0.2 * (j % 2)), [0, 1, 2, 3])
    assert flicker.ratio == pytest.approx(1) and flicker.persistence == flicker.pixel_persistence == 1
    white = sweep(lambda _, j: torch.full((1, 1, 3), 1.0 + j), [0, 1, 2])  # nothing is brighter
    assert white.largest == white.pixel == 0 and math.isnan(white.ratio)


def test_dial_sweep_measures_its_renders() -> None:
    some, camera = dialled(), ring(3, 32, 24)[1]
    seen = []
    result = dial_popping(some, camera, 3.0, steps=4, progress=lambda now: seen.append((now.done, now.total)))
    images = [render(some, camera, 3 ** (k / 4)).image.clamp(0, 1) for k in range(5)]
    want = [255 * float((b - a).square().mean().sqrt()) for a, b in zip(images[:-1], images[1:], strict=True)]
    assert result.changes == pytest.approx(want) and seen == [(k, 4) for k in range(1, 5)]
    assert result.at == pytest.approx(3 ** ((want.index(max(want)) + 1) / 4))


def test_camera_motion_alone_is_no_change() -> None:
    some, cameras = dialled(), ring(12, 32, 24)[:3]
    still = path_popping(some.replace(sigma_d=torch.full((200,), 1e9)), cameras, 3.0, steps=6)
    assert still.largest == 0 and still.pixel == 0
    moved = path_popping(some, cameras, 3.0, steps=6)
    seen = path(cameras, 6)
    assert 0 < moved.largest < 255 * float((render(some, seen[0], 3.0).image - render(some, seen[1], 3.0).image).std())


def test_path_passes_through_the_cameras_at_equal_steps() -> None:
    cameras = [dataclasses.replace(camera, near=1e-4) for camera in ring(8, 32, 24)[:3]]
    found = path(cameras, 40)
    assert len(found) == 41 and {camera.near for camera in found} == {1e-4}
    for want, got in ((cameras[0], found[0]), (cameras[2], found[-1])):
        assert torch.allclose(got.viewmat, want.viewmat, atol=1e-5)
    centres = torch.stack([camera.position for camera in found])
    gaps = (centres[1:] - centres[:-1]).norm(dim=1)
    assert gaps.max() < 1.001 * gaps.median()  # one step cuts the corner at the camera in the middle
    assert (centres - cameras[1].position).norm(dim=1).min() < 0.51 * gaps.max()


def adversary(normalizer: str, cut: str) -> tuple[Gaussians, list[Camera]]:
    """Four coincident opaque white Gaussians, culled together at s = 2.2 with max_sv 5 and the default tau, two
    black ones behind them, and one far away that a camera sees once it has turned."""
    camera = ring(1, 32, 24)[0]
    forward, right = camera.viewmat[2, :3], camera.viewmat[0, :3]
    means = torch.cat([torch.zeros(4, 3), torch.stack([forward, 2 * forward, 60 * forward + 40 * right])])
    some = gaussians(7, 0, 0).replace(
        means=means, log_scales=torch.full((7, 3), math.log(0.4)), opacity_logits=torch.full((7,), 3.0),
        sh0=torch.tensor([1.7] * 4 + [-1.7] * 3)[:, None, None].expand(7, 1, 3),
    )  # fmt: skip
    config = dataclasses.replace(AdaptConfig().attenuation(4.0), normalizer=normalizer, cut=cut)
    leave = torch.tensor([2.2] * 4 + [3.0, 4.0, 5.0])
    sigma = sigma_for_extinction(some.opacity_logits, normalized_distances(means, camera, config), leave, config)
    turn = torch.eye(4)
    turn[[0, 0, 2, 2], [0, 2, 0, 2]] = torch.tensor([0.8, -0.6, 0.6, 0.8])
    return with_dial(some, sigma, config), [camera, dataclasses.replace(camera, viewmat=turn @ camera.viewmat)]


def test_soft_culling_bounds_popping_and_hard_culling_does_not() -> None:
    """Drawn opacity changes by at most 2.73 per unit of log s up to max_sv 5, the footprint of a Gaussian that grows
    by 2/e growth_d, which is 1; the rasterizer adds one level each. Six Gaussians lie behind each other."""
    pixels = {}
    for cut, steps in product(("soft", "hard"), (60, 120)):
        some, cameras = adversary("scene", cut)
        some = some.replace(growth_d=torch.ones(7))
        pixels[cut, steps] = dial_popping(some, cameras[0], 5.0, steps=steps).pixel
        assert cut == "hard" or pixels[cut, steps] < 6 * (255 * (2.73 + 2 / math.e) * math.log(5) / steps + 1)
    assert pixels["soft", 120] < 0.7 * pixels["soft", 60]
    assert pixels["hard", 120] > 0.9 * pixels["hard", 60] > 30


def test_scene_normalizer_does_not_pop_as_a_camera_turns() -> None:
    """A far Gaussian that enters the view changes the paper's maximum, and with it every opacity, at once."""
    for normalizer in ("scene", "max"):
        some, cameras = adversary(normalizer, "soft")
        pixels = [path_popping(some, cameras, 2.0, steps=steps).pixel for steps in (10, 20)]
        assert max(pixels) < 0.05 if normalizer == "scene" else pixels[1] > 0.9 * pixels[0] > 20
