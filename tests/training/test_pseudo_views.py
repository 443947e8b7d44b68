"""Cameras placed from the Gaussians alone, and the checkpoint's own pictures."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

import clod_adapter as clod
import scenes
from clod_adapter.evaluation.baselines import matching_dial
from clod_adapter.training.pseudo_views import (
    FEW,
    FIELD,
    HEIGHT,
    OWN,
    WIDTH,
    add_pseudo_views,
    place_cameras,
    render_pseudo_views,
    typical_reach,
)


@pytest.fixture(scope="module")
def blob() -> clod.Gaussians:
    return scenes.gaussians(400, 1, 0, size=0.05)


def ball(n: int, seen_from: Tensor) -> clod.Gaussians:
    """An opaque sphere of small discs, whose higher bands are strong towards ``seen_from`` only, as training leaves
    them, with a floater far out."""
    k = torch.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, math.pi * (1 + 5**0.5) * k
    means = torch.stack([(1 - z * z).sqrt() * turn.cos(), (1 - z * z).sqrt() * turn.sin(), z], 1)
    means = torch.cat([means, torch.tensor([[0.0, 0.0, 1e4]])])
    logs = torch.full((n + 1, 3), 0.05).log()
    logs[-1] = math.log(300.0)
    # Band 1 alone is odd in the direction; a constant over its two ends is taken away by facing: only what lies on
    # the seen half has any.
    facing = (torch.nn.functional.normalize(means, dim=1) @ seen_from).clamp(min=0)
    shN = facing[:, None, None] * torch.stack([-seen_from[1], seen_from[2], -seen_from[0]])[None, :, None]
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(n + 1, 4).contiguous()
    sh0 = torch.zeros(n + 1, 1, 3)
    return clod.Gaussians(means, quats, logs, torch.full((n + 1,), 3.0), sh0, shN.expand(-1, -1, 3).contiguous())


def test_same_seed_same_cameras(blob: clod.Gaussians) -> None:
    one, two, other = (torch.stack([c.viewmat for c in place_cameras(blob, views=6, seed=seed)]) for seed in (1, 1, 2))
    assert torch.equal(one, two) and not torch.equal(one, other)


def test_cameras_are_proper_and_see_the_scene(blob: clod.Gaussians) -> None:
    cameras = place_cameras(blob, views=12)
    assert len(cameras) == 12 and len({c.name for c in cameras}) == 12
    for camera in cameras:
        rotation = camera.viewmat[:3, :3]
        assert camera.viewmat.isfinite().all() and torch.det(rotation) == pytest.approx(1, abs=1e-5)
        assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-5)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert 2 * math.degrees(math.atan(WIDTH / 2 / float(camera.K[0, 0]))) == pytest.approx(FIELD)
        assert clod.render(blob, camera).alpha.mean() > 0.02
    forward = torch.stack([c.viewmat[2, :3] for c in cameras])
    assert (forward @ forward.T).min() < 0  # from all around


def test_cameras_are_outside_of_the_gaussians() -> None:
    truth = ball(1500, torch.tensor([0.0, 0.0, 1.0]))
    for camera in place_cameras(truth, views=12):
        distances = (truth.means[:-1] - camera.position).norm(dim=1)
        assert distances.min() > 3 * 0.05 and camera.position.norm() > 1


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_cameras_stand_where_the_higher_bands_say_it_was_seen_from(axis: int) -> None:
    side = torch.zeros(3)
    side[axis] = 1.0
    positions = torch.stack([c.position for c in place_cameras(ball(1500, side), views=12)])
    assert (torch.nn.functional.normalize(positions, dim=1) @ side).mean() > 0.4


def test_the_unit_and_the_frame_play_no_part(blob: clod.Gaussians) -> None:
    far = blob.replace(means=blob.means * 64, log_scales=blob.log_scales + math.log(64))
    assert typical_reach(far) == pytest.approx(64 * typical_reach(blob), rel=1e-4)
    near = torch.stack([c.position for c in place_cameras(blob, views=5)])
    assert torch.allclose(torch.stack([c.position for c in place_cameras(far, views=5)]) / 64, near, atol=1e-2)


def test_without_higher_bands_it_works_too(blob: clod.Gaussians) -> None:
    assert len(place_cameras(blob.replace(shN=blob.shN[:, :0]), views=4)) == 4


def test_what_is_not_finite_or_not_visible_plays_no_part(blob: clod.Gaussians) -> None:
    bad = scenes.gaussians(30, 1, 3)
    bad = bad.replace(
        means=torch.cat([torch.full((10, 3), math.inf), bad.means[10:]]),
        shN=torch.cat([bad.shN[:10], torch.full_like(bad.shN[:10], math.nan), bad.shN[20:]]),
        opacity_logits=torch.cat([bad.opacity_logits[:20], torch.full((10,), -30.0)]),
    )
    both = clod.Gaussians(**{name: torch.cat([value, getattr(bad, name)]) for name, value in blob.tensors().items()})
    assert [c.viewmat.tolist() for c in place_cameras(both, views=4)] == [
        c.viewmat.tolist() for c in place_cameras(blob, views=4)
    ]
    with pytest.raises(clod.ClodError, match="no Gaussian that is visible and finite"):
        place_cameras(bad)


def test_progress_reaches_the_end(blob: clod.Gaussians) -> None:
    seen: list[tuple[int, int]] = []
    cameras = place_cameras(blob, views=3, progress=lambda *at: seen.append(at))
    assert seen[-1][0] == seen[-1][1] == len(seen)
    seen.clear()
    render_pseudo_views(blob, cameras, progress=lambda *at: seen.append(at))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_the_pictures_are_the_checkpoints_own(blob: clod.Gaussians) -> None:
    cameras = scenes.ring(9, 40, 30)
    scene = render_pseudo_views(blob, cameras)
    assert [view.camera for view in scene.test] == [cameras[0], cameras[8]] and len(scene.train) == 7
    image = (clod.render(blob, cameras[1]).image.clamp(0, 1) * 255).round().to(torch.uint8)
    assert torch.equal(scene.train[0].image, image)
    assert "7 placed cameras to train on, 2 held out, 40x30" in scene.notes[0]
    assert render_pseudo_views(blob, cameras[:1]).test == ()


def test_the_teacher_of_a_file_with_a_dial_is_its_full_quality(blob: clod.Gaussians) -> None:
    dialled = clod.attach(blob, torch.full((len(blob),), 0.3))
    assert dialled.attenuation is not None
    dialled = dialled.replace(attenuation=dataclasses.replace(dialled.attenuation, scene_distance=4.0))
    cameras = scenes.ring(2, 40, 30)
    own = (clod.render(dialled, cameras[1], 1.0).image.clamp(0, 1) * 255).round().to(torch.uint8)
    assert torch.equal(render_pseudo_views(dialled, cameras).train[0].image, own)
    assert not torch.equal(render_pseudo_views(blob, cameras).train[0].image, own)


def test_a_dial_learned_from_placed_views_serves_views_it_never_saw() -> None:
    """End to end: at the same count it beats the untrained start on other cameras."""
    base, scene = scenes.capture(300, views=8, seed=2)
    placed = render_pseudo_views(base, place_cameras(base, views=16))
    config = clod.AdaptConfig(max_sv=4, iters=0)
    untrained = clod.adapt(base, placed, config).gaussians
    trained = clod.adapt(base, placed, dataclasses.replace(config, iters=150)).gaussians
    (after,) = clod.evaluate(trained, scene.test, [4.0])
    same = matching_dial(untrained, [view.camera for view in scene.test], after.kept)
    (before,) = clod.evaluate(untrained, scene.test, [same])
    assert before.kept == pytest.approx(after.kept, abs=1) and after.psnr > before.psnr + 0.5


def test_few_photographs_get_company(blob: clod.Gaussians) -> None:
    views, config = scenes.photograph(blob, scenes.ring(FEW, 24, 18)), clod.AdaptConfig()
    enough = clod.Scene(views, ())
    assert add_pseudo_views(blob, enough, config) == (enough, config)
    scene, lighter = add_pseudo_views(blob, clod.Scene(views[:1], views[1:]), config)
    assert scene.train[0] is views[0] and len(scene.train) == 1 + OWN and scene.test == views[1:]
    assert "only 1 photographs" in scene.notes[-1]
    assert lighter.lr_means == config.lr_means / 2 and lighter.lr_sigma == config.lr_sigma


def test_few_photographs_of_a_checkpoint_that_no_camera_can_be_placed_for(blob: clod.Gaussians) -> None:
    faint = blob.replace(opacity_logits=torch.full((len(blob),), -4.6))  # fainter than what is looked for
    views, config = scenes.photograph(faint, scenes.ring(2, 24, 18)), clod.AdaptConfig(iters=1)
    scene, lighter = add_pseudo_views(faint, clod.Scene(views, ()), config)
    assert scene.train == views and "none of the checkpoint's own pictures can be added" in scene.notes[-1]
    assert clod.adapt(faint, scene, lighter).steps == 1


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_cameras_are_placed_in_any_unit(blob: clod.Gaussians, unit: float) -> None:
    other = blob.replace(means=blob.means * unit, log_scales=blob.log_scales + math.log(unit))
    here, there = (render_pseudo_views(g, place_cameras(g, views=8)) for g in (blob, other))
    light = [torch.stack([view.image for view in scene.train]).float().mean().item() for scene in (here, there)]
    assert light[0] > 5 and light[1] == pytest.approx(light[0], rel=0.3)  # roundings choose other cameras
