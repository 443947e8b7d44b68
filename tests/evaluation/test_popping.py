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
from itertools import pairwise, product

import numpy as np
import pytest
import torch

from clod_adapter import AttenuationConfig, Camera, render, with_dial
from clod_adapter.config import FORMS
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.paper import TAU
from clod_adapter.evaluation.popping import dial_popping, path, path_popping, sweep
from clod_adapter.gaussians import SH_C0
from clod_adapter.rasterizers import for_device
from clod_adapter.rasterizers.protocol import T_MIN
from runs import counted
from scenes import gaussians, ring, seeded


def dialled():
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
    model = dialled()
    camera = ring(3, 32, 24)[1]
    steps = []
    result = dial_popping(model, camera, 3.0, steps=4, progress=counted(steps))
    images = [render(model, camera, 3 ** (k / 4)).image.clamp(0, 1) for k in range(5)]
    want = [255 * float((b - a).square().mean().sqrt()) for a, b in pairwise(images)]
    assert result.changes == pytest.approx(want) and steps == [(k, 4) for k in range(1, 5)]
    assert result.at == pytest.approx(3 ** ((want.index(max(want)) + 1) / 4))


def test_camera_motion_alone_is_no_change():
    model = dialled()
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


def adversary(form):
    """Four coincident opaque white Gaussians that end together at s = 2.2, and three black ones
    behind them, of which one is far away and comes into view once the camera has turned.
    """
    camera = ring(1, 32, 24)[0]
    forward = camera.viewmat[2, :3]
    right = camera.viewmat[0, :3]
    means = torch.cat(
        [torch.zeros(4, 3), torch.stack([forward, 2 * forward, 60 * forward + 40 * right])]
    )
    model = gaussians(7, 0, 0).replace(
        means=means,
        log_scales=torch.full((7, 3), math.log(0.4)),
        opacity_logits=torch.full((7,), 3.0),
        sh0=torch.tensor([1.7] * 4 + [-1.7] * 3)[:, None, None].expand(7, 1, 3),
    )
    config = AttenuationConfig(form=form, scene_distance=4.0)
    ends = torch.tensor([2.2] * 4 + [3.0, 4.0, 5.0])
    sigma = ends * normalized_distances(means, camera, config)
    if form == "paper":
        sigma = sigma / (2 * (model.opacities / (TAU * ends)).log()).sqrt()
    turn = torch.eye(4)
    turn[[0, 0, 2, 2], [0, 2, 0, 2]] = torch.tensor([0.8, -0.6, 0.6, 0.8])
    model = with_dial(model, sigma, config).replace(growth_d=torch.ones(7))
    return model, [camera, dataclasses.replace(camera, viewmat=turn @ camera.viewmat)]


def test_a_dial_pops_nowhere_and_the_papers_form_does():
    pixels = {}
    for form, steps in product(FORMS, (120, 240)):
        model, cameras = adversary(form)
        pixels[form, steps] = dial_popping(model, cameras[0], 5.0, steps=steps).pixel
        assert form == "paper" or pixels[form, steps] <= most(7, math.log(5) / steps)
    assert pixels["ours", 240] < 0.6 * pixels["ours", 120]
    assert pixels["paper", 240] > 0.9 * pixels["paper", 120] > 5


def test_a_camera_that_turns_changes_nothing():
    """In the paper's form, a far Gaussian that enters the view changes the unit, and with it all
    opacities, at once.
    """
    for form in FORMS:
        model, cameras = adversary(form)
        pixels = [path_popping(model, cameras, 2.0, steps=steps).pixel for steps in (10, 20)]
        assert max(pixels) < 0.05 if form == "ours" else pixels[1] > 0.9 * pixels[0] > 20


def most(count, step):
    """The largest change of a pixel with so many Gaussians, whose growth_d is at most 1."""
    return count * (255 * (4 + 2 / math.e) * step + 1) + 2 * 255 * T_MIN


def lines_of_sight(seed):
    """Two to four Gaussians on each of 108 lines of sight, black or white, that let through a
    little less than T_MIN at s = 1, and more as they fade. On the first line, a black one fades in
    front of a white one that ends the pixel.
    """
    random = np.random.default_rng(seed)
    rows = []
    for x, y in product(range(-44, 48, 8), range(-32, 36, 8)):
        count = 2 if not rows else random.integers(2, 5)
        decades = random.dirichlet(np.ones(count)) * random.uniform(4, 4.4)
        for opacity in 1 - 10**-decades:
            depth = random.uniform(2, 3)
            reach = random.uniform(1, 2.5)
            rows.append(
                [x, y, depth, opacity, depth * reach, random.integers(2), random.uniform(-1, 1)]
            )
    rows[:2] = [[-44, -32, 2, 0.93, 6.6, 0, 0], [-44, -32, 3, 0.9997, SIGMA_MAX, 1, 0]]
    table = torch.tensor(np.array(rows), dtype=torch.float32)
    depths, opacities, reaches = table[:, 2:5].unbind(1)
    white, growth_d = table[:, 5:].unbind(1)
    means = torch.cat([table[:, :2] / 100, torch.ones(len(rows), 1)], 1) * depths[:, None]
    model = gaussians(len(rows), 0, 0).replace(
        means=means,
        log_scales=(0.005 * depths).log()[:, None].repeat(1, 3),
        opacity_logits=opacities.logit(),
        sh0=((white - 0.5) / SH_C0)[:, None, None].repeat(1, 1, 3),
    )
    K = torch.tensor([[100.0, 0, 48.5], [0, 100, 36.5], [0, 0, 1]])
    attenuation = AttenuationConfig(reference_distance=2.0)
    return with_dial(model, reaches, attenuation, growth_d), Camera(torch.eye(4), K, 96, 72)


@pytest.mark.parametrize("seed", [0, 1])
def test_no_pixel_jumps_where_it_ends(seed):
    """As the dial turns, and as a camera moves back that the distances are from, in 250 steps that
    double d s.
    """
    model, view = lines_of_sight(seed)
    assert dial_popping(model, view, 2.0, steps=250).pixel <= most(4, math.log(2) / 250)
    places = [2 ** (k / 250) for k in range(251)]

    def picture(_, j):
        back = torch.eye(4)
        back[2, 3] = 2 * (places[j] - 1)
        return for_device(torch.device("cpu")).draw(
            model, view, seen_from=dataclasses.replace(view, viewmat=back)
        )[0]

    with torch.no_grad():
        assert sweep(picture, places).pixel <= most(4, math.log(2) / 250)
