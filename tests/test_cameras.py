"""Cameras and views: conventions, checks, extent and near plane."""

import dataclasses

import pytest
import torch

from clod_adapter import ClodError, render
from clod_adapter.cameras import NEAR, Camera, Scene, View, camera_extent, in_its_unit
from clod_adapter.config import CLASSIC
from scenes import camera, gaussians, photograph, ring


def test_bad_cameras_and_images_are_named() -> None:
    good = dataclasses.replace(camera(), name="x.png")
    for change in ({"viewmat": torch.eye(3)}, {"K": torch.eye(4)}, {"width": 0}, {"height": -1}):
        with pytest.raises(ClodError, match=r"camera 'x\.png'"):
            dataclasses.replace(good, **change)
    for image in (torch.zeros(45, 61, 3), torch.zeros(61, 45, 3).byte(), torch.zeros(45, 61).byte()):
        with pytest.raises(ClodError, match=r"view 'x\.png': image must be uint8 of shape \(45, 61, 3\)"):
            View(good, image)


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


def test_rounding_between_cameras_has_no_extent() -> None:
    """Of a camera that turns on a tripod."""
    turning = ring(10, 8, 6)
    for each in turning:
        each.viewmat[:3, 3] = -each.viewmat[:3, :3] @ torch.tensor([3.0, -2.0, 1.5])
    assert len({tuple(each.position.tolist()) for each in turning}) > 1 and camera_extent(turning) == 0
    views = tuple(View(c, torch.zeros(6, 8, 3, dtype=torch.uint8)) for c in turning)
    assert in_its_unit(Scene(views, ())).train[0].camera.near == NEAR


@pytest.mark.parametrize(("radius", "near"), [(1e-4, 1e-6), (0.5, 5e-3), (2.0, NEAR), (1e4, NEAR)])
def test_near_plane_of_small_scenes(radius: float, near: float) -> None:
    views = tuple(View(c, torch.zeros(6, 8, 3, dtype=torch.uint8)) for c in ring(8, 8, 6, radius=radius))
    scene = in_its_unit(Scene(views[1:], views[:1]))
    found = {view.camera.near for view in (*scene.train, *scene.test)}
    assert len(found) == 1 and found.pop() == pytest.approx(near, rel=0.25)
    assert in_its_unit(Scene(views[:1], ())).train[0].camera.near == NEAR  # one camera says nothing


def test_halved_views_are_means_of_four_pixels() -> None:
    """With the camera of the half size, and a filter with which renders are close to such means."""
    some, whole = gaussians(300, 1, 0, size=0.2), ring(1, 121, 90)[0]
    view = photograph(some, [whole])[0]
    half, image = view.halved(), view.image[:90, :120].double()
    assert (half.camera.width, half.camera.height) == (60, 45)
    assert float((half.image - image.unflatten(0, (45, 2)).unflatten(2, (60, 2)).mean((1, 3))).abs().max()) <= 0.5
    errors = []
    for screen_filter in (CLASSIC, CLASSIC.halved()):
        shown = render(some.replace(screen_filter=screen_filter), half.camera).image.clamp(0, 1)
        errors.append(float((shown - half.image / 255).square().mean()))
    assert errors[1] < errors[0] / 4


def test_arrays_become_tensors() -> None:
    view = photograph(gaussians(5, 0, 0), ring(1, 20, 16))[0]
    arrays = view.camera.viewmat.double().numpy(), view.camera.K.double().numpy()
    again = View(Camera(*arrays, 20, 16), view.image.numpy()[:, ::-1])
    assert torch.equal(again.camera.viewmat, view.camera.viewmat) and again.camera.K.dtype == torch.float32
    assert torch.equal(again.image, view.image.flip(1))
    assert repr(again) == "View('', 20x16)" and repr(Scene((again,), ())).endswith("0 held out, 20x16)")
