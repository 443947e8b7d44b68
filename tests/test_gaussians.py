"""Cameras and views: conventions, checks, extent and near plane. Gaussians: shapes, selection, and
SH degrees.
"""

import dataclasses
import re

import numpy as np
import pytest
import torch
from refusals import refused

from clod_adapter import AttenuationConfig, render
from clod_adapter.cameras import NEAR, Camera, Scene, View, camera_extent, in_its_unit
from clod_adapter.config import CLASSIC
from scenes import camera, gaussians, photograph, ring


def test_bad_images_are_named():
    view = dataclasses.replace(camera(), name="x.png")
    right = torch.zeros(45, 61, 3)
    for image in (right, right.byte().transpose(0, 1), right[..., 0].byte()):
        with refused(r"view 'x\.png': image must be uint8 of shape \(45, 61, 3\)"):
            View(view, image)


def test_extent_of_cameras():
    cameras = ring(8, 8, 6, radius=2.0)
    centres = torch.stack([camera.position for camera in cameras])
    farthest = (centres - centres.mean(0)).norm(dim=1).max().item()
    assert camera_extent(cameras) == pytest.approx(1.1 * farthest)
    assert camera_extent(cameras[:1]) == 0
    viewmat = torch.eye(4)
    viewmat[2, 3] = 1e6
    far = dataclasses.replace(cameras[0], viewmat=viewmat)
    # The one far off moves the mean of nine by a ninth of its distance, from which all the others
    # are then as far.
    assert camera_extent([*cameras, far]) <= 3.3 * 1e6 / 9 * 1.01


def black(cameras):
    return tuple(View(camera, torch.zeros(6, 8, 3, dtype=torch.uint8)) for camera in cameras)


def test_rounding_between_cameras_has_no_extent():
    """Of a camera that turns on a tripod."""
    turning = ring(10, 8, 6)
    for turned in turning:
        turned.viewmat[:3, 3] = -turned.viewmat[:3, :3] @ torch.tensor([3.0, -2.0, 1.5])
    assert len({tuple(camera.position.tolist()) for camera in turning}) > 1
    assert camera_extent(turning) == 0
    assert in_its_unit(Scene(black(turning), ())).train[0].camera.near == NEAR


@pytest.mark.parametrize("radius, near", [(1e-4, 1e-6), (0.5, 5e-3), (2.0, NEAR), (1e4, NEAR)])
def test_near_plane_of_small_scenes(radius, near):
    views = black(ring(8, 8, 6, radius=radius))
    scene = in_its_unit(Scene(views[1:], views[:1]))
    (placed,) = {view.camera.near for view in (*scene.train, *scene.test)}
    assert placed == pytest.approx(near, rel=0.25)
    assert in_its_unit(Scene(views[:1], ())).train[0].camera.near == NEAR  # one camera says nothing


def test_halved_views_are_means_of_four_pixels():
    """With the camera of the half size, and a filter with which renders are close to such means."""
    model = gaussians(300, 1, 0, size=0.2)
    (view,) = photograph(model, ring(1, 121, 90))
    half = view.halved()
    assert half.camera.width == 60 and half.camera.height == 45
    blocks = view.image[:90, :120].double().unflatten(0, (45, 2)).unflatten(2, (60, 2))
    assert float((half.image - blocks.mean((1, 3))).abs().max()) <= 0.5
    errors = []
    for screen_filter in (CLASSIC, CLASSIC.halved()):
        image = render(model.replace(screen_filter=screen_filter), half.camera).image.clamp(0, 1)
        errors.append(float((image - half.image / 255).square().mean()))
    assert errors[1] < errors[0] / 4


def test_arrays_become_tensors():
    view = photograph(gaussians(5, 0, 0), ring(1, 20, 16))[0]
    arrays = view.camera.viewmat.double().numpy(), view.camera.K.double().numpy()
    again = View(Camera(*arrays, 20, 16), view.image.numpy()[:, ::-1])
    assert torch.equal(again.camera.viewmat, view.camera.viewmat)
    assert again.camera.K.dtype == torch.float32
    assert torch.equal(again.image, view.image.flip(1))
    assert repr(again) == "View('', 20x16)"
    assert repr(Scene((again,), ())).endswith("0 held out, 20x16)")


CONFIG = AttenuationConfig()


def plain(**changes):
    return gaussians(5, 2, 0).replace(**changes)


def adapted():
    return plain(sigma_d=torch.arange(5.0), attenuation=CONFIG)


def test_wrong_shapes_are_named():
    for name, shape in (
        ("means", (5, 2)),
        ("quats", (5, 3)),
        ("log_scales", (4, 3)),
        ("opacity_logits", (5, 1)),
        ("sh0", (5, 3)),
        ("shN", (5, 7, 3)),
        ("shN", (4, 8, 3)),
        ("shN", (5, 8, 4)),
        ("sigma_d", (4,)),
        ("growth_d", (5, 1)),
    ):
        with refused(rf"Gaussians.{name} has shape {re.escape(str(shape))}, expected"):
            adapted().replace(**{name: torch.zeros(shape)})
    for changes in ({"sigma_d": torch.ones(5)}, {"attenuation": CONFIG}):
        with refused("both sigma_d and attenuation"):
            plain(**changes)


@pytest.mark.parametrize("degree, used", [(0, 0), (1, 0), (2, 1), (3, 3), (3, 1)])
def test_empty_sh_degrees_are_removed(degree, used):
    """The highest degrees that are 0 are removed; one coefficient keeps its degree and all
    below.
    """
    model = gaussians(7, degree, 0)
    bands = (used + 1) ** 2 - 1
    model.shN[:, max(used**2 - 1, 0) :] = 0
    if used:
        model.shN[4, bands - 1, 2] = -1e-30
    found = model.without_empty_bands()
    assert found.sh_degree == used and torch.equal(found.shN, model.shN[:, :bands])
    assert found is model if used == degree else torch.equal(found.means, model.means)


def test_rows_by_brackets():
    model = adapted()
    for rows, wanted in (
        (slice(3), [0, 1, 2]),
        (slice(None, None, 2), [0, 2, 4]),
        ([3, 0], [3, 0]),
        (np.array([4, -1]), [4, 4]),
        (np.array([0, 1, 1, 0, 0], bool), [1, 2]),
        (model.sigma_d > 2.5, [3, 4]),
        ([], []),
    ):
        found = model[rows]
        assert found.attenuation is CONFIG and len(found) == len(wanted)
        for name, value in found.tensors().items():
            assert torch.equal(value, getattr(model, name)[wanted]), name


@pytest.mark.parametrize(
    "rows", [2, torch.ones(4, dtype=torch.bool), [5], torch.zeros(2, 2, dtype=torch.long)]
)
def test_other_rows_are_refused(rows):
    with refused("give a slice, indices .M. or a mask .5.|there are 5 Gaussians, and index 5"):
        adapted()[rows]


def test_gaussians_are_compared_as_a_whole():
    model = adapted()
    arrays = {name: value.double().numpy() for name, value in model.tensors().items()}
    assert model == model.replace(**arrays)
    for other in (
        model[:4],
        model.replace(means=model.means + 1),
        model.replace(means=model.means.double()),
        plain(),
        "text",
        model.replace(growth_d=torch.ones(5)),
        model.replace(attenuation=AttenuationConfig(max_sv=2)),
    ):
        assert (model == other) is False


def test_repr_is_short_and_devices_have_names():
    model = adapted()
    assert repr(plain()) == "Gaussians(5, SH degree 2, no dial, cpu)"
    grown = model.replace(growth_d=torch.ones(5))
    assert repr(grown) == "Gaussians(5, SH degree 2, dial to 5 with growth, cpu)"
    assert repr(model.to("meta")) == "Gaussians(5, SH degree 2, dial to 5, meta)"
    assert model.cpu().means.device.type == "cpu"
