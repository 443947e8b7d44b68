"""Cameras placed without photographs."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import clod_adapter as clod
from clod_adapter.initialization.importance import coverage
from clod_adapter.training import camera_placement
from clod_adapter.training.camera_placement import FIELD, HEIGHT, WIDTH, place_cameras


def ball(n: int, seen_from: Tensor) -> clod.Gaussians:
    """An opaque sphere of small discs and a far floater, with SH degree 1 strong towards ``seen_from`` alone.

    As after training. Degree 1 is odd in the direction: it is 0 on the half that is not seen.
    """
    k = torch.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, math.pi * (1 + 5**0.5) * k
    means = torch.stack([(1 - z * z).sqrt() * turn.cos(), (1 - z * z).sqrt() * turn.sin(), z], 1)
    means = torch.cat([means, torch.tensor([[0.0, 0.0, 1e4]])])
    logs = torch.full((n + 1, 3), 0.05).log()
    logs[-1] = math.log(300.0)
    facing = (torch.nn.functional.normalize(means, dim=1) @ seen_from).clamp(min=0)
    shN = facing[:, None, None] * torch.stack([-seen_from[1], seen_from[2], -seen_from[0]])[None, :, None]
    quats, sh0 = torch.tensor([[1.0, 0, 0, 0]]).repeat(n + 1, 1), torch.zeros(n + 1, 1, 3)
    return clod.Gaussians(means, quats, logs, torch.full((n + 1,), 3.0), sh0, shN.repeat(1, 1, 3))


def test_placed_cameras_are_valid_and_see_the_scene(blob: clod.Gaussians) -> None:
    told: list[tuple[int, int]] = []
    cameras = place_cameras(blob, views=12, progress=lambda now: told.append((now.done, now.total)))
    assert told[-1][0] == told[-1][1] == len(told)
    assert len(cameras) == 12 and len({c.name for c in cameras}) == 12
    for camera in cameras:
        rotation = camera.viewmat[:3, :3]
        assert camera.viewmat.isfinite().all() and torch.det(rotation) == pytest.approx(1, abs=1e-5)
        assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-5)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert 2 * math.degrees(math.atan(WIDTH / 2 / float(camera.K[0, 0]))) == pytest.approx(FIELD)
        assert clod.render(blob, camera).alpha.mean() > 0.02
    plain = blob.replace(shN=blob.shN[:, :0])
    one, two, other = (torch.stack([c.viewmat for c in place_cameras(plain, views=4, seed=k)]) for k in (1, 1, 2))
    assert len(one) == 4 and torch.equal(one, two) and not torch.equal(one, other)


def test_a_scene_gets_as_many_cameras_as_show_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rows of spheres need more cameras than one sphere; nearly every disc is shown in the end."""
    monkeypatch.setattr(camera_placement, "VIEWS", 8)
    monkeypatch.setattr(camera_placement, "MOST", 64)
    one = ball(300, torch.eye(3)[2]).select(torch.arange(300))
    one = one.replace(shN=one.shN[:, :0])
    places = [torch.tensor([8.0 * x, 0.0, 8.0 * z]) for x in range(8) for z in (0, 1)]
    street = {name: torch.cat([value] * len(places)) for name, value in one.tensors().items()}
    street["means"] = torch.cat([one.means + place for place in places])
    many = clod.Gaussians(**street)
    few, more = place_cameras(one), place_cameras(many)
    assert 8 <= len(few) < len(more) <= 64 and len({c.name for c in more}) == len(more)
    seen = torch.stack([coverage(many, many.opacities, camera) for camera in more]).amax(0)
    assert float((seen >= 0.5).float().mean()) > 0.95


@pytest.mark.parametrize(("axis", "few"), [(0, False), (1, False), (2, False), (2, True)])
def test_cameras_face_the_side_where_sh_was_trained(axis: int, few: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a sample of the Gaussians decides."""
    side = torch.eye(3)[axis]
    truth = ball(1500, side)
    if few:
        monkeypatch.setattr(camera_placement, "SAMPLE", 500)
    positions = torch.stack([c.position for c in place_cameras(truth, views=12)])
    assert (torch.nn.functional.normalize(positions, dim=1) @ side).mean() > 0.4
    assert torch.cdist(positions, truth.means[:-1]).min() > 3 * 0.05 and positions.norm(dim=1).min() > 1
