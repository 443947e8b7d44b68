"""Cameras and views: conventions and what is refused."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from clod_adapter.cameras import NEAR, Camera, Scene, View, camera_extent, in_its_unit
from clod_adapter.errors import ClodError
from scenes import camera, in_front, ring


@pytest.mark.parametrize("view", [camera(), *ring(3, 20, 16)], ids=range(4))
def test_position_is_where_the_world_is_zero(view: Camera) -> None:
    at_itself = view.viewmat @ torch.cat([view.position, torch.ones(1)])
    torch.testing.assert_close(at_itself, torch.tensor([0.0, 0, 0, 1]), rtol=0, atol=1e-6)


def test_axes_are_opencv_s() -> None:
    """The shared test cameras look down +z with y down, as the package reads them."""
    view = camera()
    back = (view.viewmat[:3, :3] @ in_front(view, torch.tensor([[0.1, 0.2, 3.0]]))[0]) + view.viewmat[:3, 3]
    torch.testing.assert_close(back, torch.tensor([0.1, 0.2, 3.0]))
    for other in ring(5, 20, 16):
        torch.testing.assert_close(torch.linalg.det(other.viewmat[:3, :3]), torch.tensor(1.0))
        ahead = other.viewmat[:3, 3]  # the origin, which they look at
        assert ahead[2] > 3 and ahead[:2].abs().max() < 1e-5


@pytest.mark.parametrize(
    "change", [{"viewmat": torch.eye(3)}, {"K": torch.eye(4)}, {"width": 0}, {"height": -1}], ids=str
)
def test_impossible_cameras_are_named(change: dict[str, object]) -> None:
    with pytest.raises(ClodError, match=r"camera 'x\.png'"):
        dataclasses.replace(camera(), name="x.png", **change)


@pytest.mark.parametrize(
    "image",
    [torch.zeros(45, 61, 3), torch.zeros(61, 45, 3, dtype=torch.uint8), torch.zeros(45, 61, dtype=torch.uint8)],
    ids=range(3),
)
def test_images_that_do_not_fit_are_named(image: torch.Tensor) -> None:
    with pytest.raises(ClodError, match=r"view 'x\.png': image must be uint8 of shape \(45, 61, 3\)"):
        View(dataclasses.replace(camera(), name="x.png"), image)


def test_all_three_are_frozen() -> None:
    view = View(camera(), torch.zeros(45, 61, 3, dtype=torch.uint8))
    for thing, name in ((view.camera, "width"), (view, "image"), (Scene((view,), ()), "train")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(thing, name, None)
    assert Scene((view,), ()).notes == ()


def test_extent_of_cameras() -> None:
    cameras = ring(8, 8, 6, radius=2.0)
    centres = torch.stack([camera.position for camera in cameras])
    assert camera_extent(cameras) == pytest.approx(1.1 * (centres - centres.mean(0)).norm(dim=1).max().item())
    assert camera_extent(cameras[:1]) == 0
    viewmat = torch.eye(4)
    viewmat[2, 3] = 1e6
    far = dataclasses.replace(cameras[0], viewmat=viewmat)
    # The one far off moves the mean of nine by a ninth of its distance, from which all the others are then as far.
    assert camera_extent([*cameras, far]) <= 3.3 * 1e6 / 9 * 1.01
    assert camera_extent([*cameras[:1] * 5, *cameras[1:2]]) > 0


def test_what_rounding_puts_between_cameras_is_no_extent() -> None:
    place = torch.tensor([3.0, -2.0, 1.5])
    turning = []
    for each in ring(10, 8, 6):
        viewmat = each.viewmat.clone()
        viewmat[:3, 3] = -viewmat[:3, :3] @ place
        turning.append(dataclasses.replace(each, viewmat=viewmat))
    assert len({tuple(each.position.tolist()) for each in turning}) > 1
    assert camera_extent(turning) == 0
    views = tuple(View(c, torch.zeros(6, 8, 3, dtype=torch.uint8)) for c in turning)
    assert in_its_unit(Scene(views, ())).train[0].camera.near == NEAR
    # Nor does a pair beside a tripod, one on either side, have a median of roundings.
    sides = [dataclasses.replace(c, viewmat=c.viewmat.clone()) for c in turning[:2]]
    for each, sign in zip(sides, (1, -1), strict=True):
        each.viewmat[:3, 3] = -each.viewmat[:3, :3] @ (place + sign * torch.tensor([1.0, 0, 0]))
    assert camera_extent([*turning, *sides]) == pytest.approx(1.1, rel=1e-4)


@pytest.mark.parametrize(("radius", "near"), [(1e-4, 1e-6), (0.5, 5e-3), (2.0, NEAR), (1e4, NEAR)])
def test_near_plane_of_small_scenes(radius: float, near: float) -> None:
    views = tuple(View(c, torch.zeros(6, 8, 3, dtype=torch.uint8)) for c in ring(8, 8, 6, radius=radius))
    scene = in_its_unit(Scene(views[1:], views[:1]))
    found = {view.camera.near for view in (*scene.train, *scene.test)}
    assert len(found) == 1 and found.pop() == pytest.approx(near, rel=0.25)
    assert in_its_unit(Scene(views[:1], ())).train[0].camera.near == NEAR  # one camera says nothing
