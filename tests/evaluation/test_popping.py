"""The measure of popping separates a jump from a fade and excludes the camera's motion; and a dial
pops nowhere:

With a step h of log s or log d, no pixel changes by more than

    255 (4 W + 2/e n G) h + n + 2 255 T_MIN

levels, where n Gaussians are drawn on it with footprints ``exp(-q)`` that sum to W, G is the
largest ``|growth_d|``, and colours are in [0, 1]. The picture changes by at most T <= 1 per alpha.
A drawn opacity changes by at most 4 a h, a footprint by at most
``2 q exp(-q) |growth_d| h <= 2/e |growth_d| h``. An alpha that begins or ends at 1/255 adds a
level, and what is not drawn behind the end of a pixel, in either picture, T_MIN.
"""

import dataclasses
import math
from functools import partial
from itertools import pairwise

import pytest
import torch
from stability_popping import scene, swept

from clod_adapter import AttenuationConfig, Camera, render, with_dial
from clod_adapter.cameras import intrinsics
from clod_adapter.config import FORMS
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.evaluation.popping import dial_popping, path, path_popping, sweep
from clod_adapter.gaussians import SH_C0
from clod_adapter.rasterizers.protocol import T_MIN
from runs import counted
from scenes import gaussians, ring, seeded


def attenuated():
    """Gaussians that end at different dial values; scene distance 4, where the ring of cameras
    is.
    """
    reaches = torch.linspace(0.3, 4, 200)[torch.randperm(200, generator=seeded(3))]
    return with_dial(gaussians(200, 1, 0, size=0.2), reaches, AttenuationConfig(scene_distance=4.0))


def test_popping_of_a_fade_and_of_a_switch():
    """Grey rising by 1/100 a step on one of two pixels; and black that becomes grey 1/2 in one
    step.
    """
    positions = [k / 10 for k in range(11)]
    about = partial(pytest.approx, rel=1e-4)
    fade = sweep(lambda _, j: torch.tensor([[[j / 100] * 3, [0.0] * 3]]), positions)
    assert fade.steps == 10 and fade.mean == about(2.55 / math.sqrt(2))
    assert fade.ratio == about(1) and fade.persistence == about(0.5)
    assert fade.pixel == about(2.55) and fade.pixel_persistence == about(0.5)
    switch = sweep(lambda _, j: torch.full((1, 2, 3), 0.5 * (j >= 4)), positions)
    assert switch.largest == switch.pixel == 127.5 and switch.at == switch.pixel_at == 0.4
    assert switch.ratio == pytest.approx(10) and switch.persistence == switch.pixel_persistence == 1
    assert list(switch.changes) == [0, 0, 0, 127.5, *[0] * 6]
    # There and back at every step: over two steps nothing is left, which must not make it a fade.
    flicker = sweep(lambda _, j: torch.full((1, 1, 3), 0.2 * (j % 2)), [0, 1, 2, 3])
    assert flicker.ratio == about(1) and flicker.persistence == flicker.pixel_persistence == 1
    both = sweep(lambda _, j: torch.full((1, 1, 3), 0.01 * j + 0.2 * (j >= 4)), positions)
    # the jump alone
    assert both.pixel * (2 - 1 / both.pixel_persistence) == about(0.2 * 255)
    white = sweep(lambda _, j: torch.full((1, 1, 3), 1.0 + j), [0, 1, 2])  # nothing is brighter
    assert white.largest == white.pixel == 0 and math.isnan(white.ratio)


def test_dial_sweep_measures_its_renders():
    model = attenuated()
    camera = ring(3, 32, 24)[1]
    steps = []
    result = dial_popping(model, camera, 3.0, steps=4, progress=counted(steps))
    images = [render(model, camera, 3 ** (k / 4)).image.clamp(0, 1) for k in range(5)]
    want = [255 * float((b - a).square().mean().sqrt()) for a, b in pairwise(images)]
    assert result.changes == pytest.approx(want) and steps == [(k, 4) for k in range(1, 5)]
    assert result.at == pytest.approx(3 ** ((want.index(max(want)) + 1) / 4))


def test_camera_motion_alone_is_no_change():
    model = attenuated()
    cameras = ring(12, 32, 24)[:3]
    still = path_popping(model.replace(sigma_d=torch.full((200,), 1e9)), cameras, 3.0, steps=6)
    assert still.largest == 0 and still.pixel == 0
    moved = path_popping(model, cameras, 3.0, steps=6)
    images = torch.stack([render(model, camera, 3.0).image for camera in path(cameras, 6)])
    motion = 255 * (images[1:] - images[:-1]).square().mean((1, 2, 3)).sqrt()
    changes = torch.tensor(moved.changes)
    assert (changes > 0).all() and (changes < 0.7 * motion).all()


def test_path_passes_through_the_cameras_at_equal_steps():
    cameras = [dataclasses.replace(camera, near=1e-4) for camera in ring(8, 32, 24)[:3]]
    found = path(cameras, 40)
    assert len(found) == 41 and {camera.near for camera in found} == {1e-4}
    for want, got in ((cameras[0], found[0]), (cameras[2], found[-1])):
        assert torch.allclose(got.viewmat, want.viewmat, atol=1e-5)
    centres = torch.stack([camera.position for camera in found])
    gaps = (centres[1:] - centres[:-1]).norm(dim=1)
    # one step cuts the corner at the camera in the middle
    assert gaps.max() < 1.001 * gaps.median()
    assert (centres - cameras[1].position).norm(dim=1).min() < 0.51 * gaps.max()


def made_to_pop(form):
    """The benchmark's scene without the Gaussians that are not made to pop; all grow."""
    model, cameras = scene(form, others=0)
    return model.replace(growth_d=torch.ones(len(model))), cameras


def one_behind_the_other():
    """A black Gaussian that fades in front of a white one, which ends the pixel that both are in
    the middle of.
    """
    depths = torch.tensor([2.0, 3.0])
    model = gaussians(2, 0, 0).replace(
        means=depths[:, None] * torch.tensor([0.0, 0, 1]),
        log_scales=(0.005 * depths).log()[:, None].repeat(1, 3),
        opacity_logits=torch.tensor([0.93, 0.9997]).logit(),
        sh0=torch.tensor([-0.5, 0.5])[:, None, None].repeat(1, 1, 3) / SH_C0,
    )
    reaches = torch.tensor([6.6, SIGMA_MAX])
    model = with_dial(model, reaches, AttenuationConfig(reference_distance=2.0))
    return model, Camera(torch.eye(4), intrinsics(100, 100, 8.5, 6.5), 17, 13)


def test_a_dial_pops_nowhere_and_the_papers_form_does():
    """Half the step halves a fade, and leaves a pop as it is."""
    cases = [(one_behind_the_other(), "ours")]
    for form in FORMS:
        model, cameras = made_to_pop(form)
        cases.append(((model, *cameras["dial"]), form))
    for (model, camera), form in cases:
        longer, shorter = (
            dial_popping(model, camera, 5.0, steps=steps).pixel for steps in (120, 240)
        )
        if form == "ours":
            assert shorter < 0.6 * longer and longer <= most(len(model), math.log(5) / 120)
        else:
            assert shorter > 0.9 * longer > 5


def test_a_camera_that_turns_changes_nothing():
    """In the paper's form, a far Gaussian that enters the view changes the unit, and with it all
    opacities, at once.
    """
    for form in FORMS:
        pixels = [swept(*made_to_pop(form), "turn", steps).pixel for steps in (10, 20)]
        assert max(pixels) < 0.05 if form == "ours" else pixels[1] > 0.9 * pixels[0] > 20


def most(count, step):
    """The largest change of a pixel with so many Gaussians, whose growth_d is at most 1."""
    return count * (255 * (4 + 2 / math.e) * step + 1) + 2 * 255 * T_MIN
