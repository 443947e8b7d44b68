"""Pseudo views, renders of the checkpoint as target images, and the cameras that are placed for
them.
"""

import math

import numpy as np
import pytest
import torch

import clod_adapter as clod
import scenes
from clod_adapter import AdaptConfig, AttenuationConfig, Gaussians, Scene, render, with_dial
from clod_adapter.initialization.importance import coverage
from clod_adapter.training import camera_placement, pseudo_views
from clod_adapter.training.camera_placement import FIELD, HEIGHT, WIDTH, place_cameras
from clod_adapter.training.pseudo_views import (
    FARTHER,
    MOVED,
    PseudoView,
    add_pseudo_views,
    render_pseudo_views,
)
from clod_adapter.training.schedule import ViewSampler
from runs import counted
from scenes import ring


@pytest.fixture(scope="module")
def blob():
    return scenes.gaussians(400, 1, 0, size=0.05)


def test_images_are_renders_of_the_checkpoint(blob):
    """Renders of a file with a dial are at s = 1."""
    cameras = ring(9, 40, 30)
    steps = []
    attenuated = with_dial(
        blob, torch.full((len(blob),), 0.3), AttenuationConfig(scene_distance=4.0)
    )
    scene = render_pseudo_views(attenuated, cameras, progress=counted(steps))
    assert [view.camera for view in scene.test] == [cameras[0], cameras[8]]
    assert len(scene.train) == 7 and steps == [(1, 2), (2, 2)]
    image = scene.train[0].image
    assert torch.equal(image, render(attenuated, cameras[1]).pixels)
    assert not torch.equal(image, render(blob, cameras[1]).pixels)
    assert "7 pseudo views to train on, 2 held out, 40x30" in scene.notes[0]
    assert render_pseudo_views(attenuated, cameras[:1]).test == ()


def test_each_step_renders_the_checkpoint_from_another_camera(blob):
    """A photograph stays where it is."""
    cameras = ring(3, 40, 30)
    (photograph,) = scenes.photograph(blob, cameras[:1])
    sampler = ViewSampler((*render_pseudo_views(blob, cameras).train, photograph), AdaptConfig())
    drawn = [sampler.draw(k, 0.0).view for k in range(9)]
    assert sum(view is photograph for view in drawn) == 3
    for view in drawn:
        assert torch.equal(view.image, render(blob, view.camera).pixels)
        placed = any(torch.equal(view.camera.viewmat, camera.viewmat) for camera in cameras)
        assert placed == (view is photograph)


def test_few_photographs_get_pseudo_views(blob, monkeypatch):
    monkeypatch.setattr(pseudo_views, "ADDED", 9)
    monkeypatch.setattr(pseudo_views, "MANY", 12)
    around = scenes.photograph(blob, ring(12, 80, 60))
    enough = Scene(around, ())
    assert add_pseudo_views(blob, enough) == enough
    scene = add_pseudo_views(blob, Scene(around[:1], around[1:]))
    assert scene.train[:4] == 4 * around[:1] and scene.test == around[1:]
    assert "only 1 photographs to train on: 9 pseudo views" in scene.notes[-1]
    assert "each photograph is used 4 times" in scene.notes[-1]
    place = around[0].camera.viewmat
    pseudo = scene.train[4:]
    assert len(pseudo) == 9
    assert sum(torch.equal(view.camera.viewmat, place) for view in pseudo) == 4
    assert len(add_pseudo_views(blob, Scene(around[1:], ())).train) == 11 + 11 + 4
    # too faint to place a camera by
    faint = blob.replace(opacity_logits=torch.full((len(blob),), -4.6))
    scene = add_pseudo_views(faint, Scene(around[:2], ()))
    assert scene.train == around[:2] and "no pseudo views can be added" in scene.notes[-1]
    assert clod.adapt(faint, scene, AdaptConfig(iters=1)).steps == 1


def test_moved_cameras_have_the_documented_offsets(blob):
    """Of position, direction and focal length; some step back along their direction of view, up to
    FARTHER reaches.
    """
    camera = ring(1, 40, 30)[0]
    rng = np.random.default_rng(0)

    def moved(far):
        view = PseudoView(camera, blob, 3.0, far)
        return [view.moved(rng).camera for _ in range(500)]

    near = moved(0.0)
    inverse = camera.viewmat.double().inverse()
    steps = torch.stack([placed.viewmat.double() @ inverse for placed in near])
    assert steps[:, :3, 3].std(0).tolist() == pytest.approx([MOVED * 3.0] * 3, rel=0.2)
    angles = ((steps.diagonal(dim1=1, dim2=2).sum(1) - 2) / 2).clamp(-1, 1).acos()
    assert angles.square().mean().sqrt() == pytest.approx(pseudo_views.TURNED * 3**0.5, rel=0.2)
    zooms = torch.stack([each.K / camera.K for each in near])[:, [0, 1], [0, 1]].log()
    assert torch.equal(zooms[:, 0], zooms[:, 1])
    assert 0.9 < zooms.abs().max() / pseudo_views.ZOOMED <= 1.001
    eyes = torch.stack([placed.position for placed in moved(1.0)])
    behind = (camera.position - eyes) @ camera.viewmat[2, :3] / 3.0
    assert behind.min() > -6 * MOVED and FARTHER / 2 < behind.max() < FARTHER - 1 + 6 * MOVED


def ball(n, seen_from):
    """An opaque sphere of small discs and a far floater; SH degree 1, as after training, on the
    seen half alone.
    """
    k = torch.arange(n) + 0.5
    z = 1 - 2 * k / n
    turn = math.pi * (1 + 5**0.5) * k
    means = torch.stack([(1 - z * z).sqrt() * turn.cos(), (1 - z * z).sqrt() * turn.sin(), z], 1)
    means = torch.cat([means, torch.tensor([[0.0, 0.0, 1e4]])])
    logs = torch.full((n + 1, 3), 0.05).log()
    logs[-1] = math.log(300.0)
    facing = (torch.nn.functional.normalize(means, dim=1) @ seen_from).clamp(min=0)
    shN = (
        facing[:, None, None]
        * torch.stack([-seen_from[1], seen_from[2], -seen_from[0]])[None, :, None]
    )
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n + 1, 1)
    sh0 = torch.zeros(n + 1, 1, 3)
    return Gaussians(means, quats, logs, torch.full((n + 1,), 3.0), sh0, shN.repeat(1, 1, 3))


def test_placed_cameras_are_valid_and_see_the_scene(blob):
    steps = []
    cameras = place_cameras(blob, views=12, progress=counted(steps))
    assert steps[-1] == (len(steps), len(steps))
    assert len({c.name for c in cameras}) == len(cameras) == 12
    for camera in cameras:
        rotation = camera.viewmat[:3, :3]
        assert torch.det(rotation) == pytest.approx(1, abs=1e-5)
        assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-5)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        field = 2 * math.degrees(math.atan(WIDTH / 2 / float(camera.K[0, 0])))
        assert field == pytest.approx(FIELD)
        assert render(blob, camera).alpha.mean() > 0.02

    def poses(seed):
        return torch.stack([c.viewmat for c in place_cameras(blob, views=4, seed=seed)])

    one = poses(1)
    assert len(one) == 4 and torch.equal(one, poses(1)) and not torch.equal(one, poses(2))


def test_a_scene_gets_as_many_cameras_as_show_it(monkeypatch):
    """A row of spheres needs more cameras than one sphere; nearly every disc is shown in the
    end.
    """
    monkeypatch.setattr(camera_placement, "ROUND_CAMERAS", 8)
    monkeypatch.setattr(camera_placement, "MOST_CAMERAS", 40)
    one = ball(200, torch.eye(3)[2]).select(torch.arange(200)).without_bands(0)
    street = {name: torch.cat([value] * 8) for name, value in one.tensors().items()}
    street["means"] = torch.cat([one.means + torch.tensor([8.0 * x, 0.0, 0.0]) for x in range(8)])
    many = Gaussians(**street)
    few = place_cameras(one)
    more = place_cameras(many)
    assert 8 <= len(few) < len(more) <= 40 and len({c.name for c in more}) == len(more)
    seen = torch.stack([coverage(many, many.opacities, camera) for camera in more]).amax(0)
    assert float((seen >= 0.5).float().mean()) > 0.9


@pytest.mark.parametrize("axis, few", [(0, False), (2, True)])
def test_cameras_face_the_side_where_sh_was_trained(axis, few, monkeypatch):
    """Also where a sample of the Gaussians decides."""
    side = torch.eye(3)[axis]
    truth = ball(1500, side)
    if few:
        monkeypatch.setattr(camera_placement, "SAMPLE", 500)
    positions = torch.stack([c.position for c in place_cameras(truth, views=12)])
    assert (torch.nn.functional.normalize(positions, dim=1) @ side).mean() > 0.4
    assert torch.cdist(positions, truth.means[:-1]).min() > 3 * 0.05
    assert positions.norm(dim=1).min() > 1


def test_cameras_stand_within_a_closed_room():
    """Seen from outside its back is opaque too, but behind such a camera there is nothing."""
    walls = ball(1500, torch.eye(3)[2]).select(torch.arange(1500)).without_bands(0)
    walls.log_scales[::8] = math.log(0.004)
    positions = torch.stack([camera.position for camera in place_cameras(walls, views=12)])
    assert (positions.norm(dim=1) < 1).float().mean() > 0.8
