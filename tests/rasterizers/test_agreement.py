"""Every backend agrees with the float64 reference in images and gradients; gsplat's own projection
and harmonics, in torch, are one of them.
"""

import dataclasses
import math

import pytest
import torch

from clod_adapter.cameras import Camera, intrinsics
from clod_adapter.config import FILTERS, ScreenFilter
from oracle import BACKGROUND, IMAGE, ON_A_CUT, assert_agrees
from scenes import camera, in_front, scene

# Neither multiples of 4 nor of a tile, but one; principal points on either side.
SIZES = [(61, 45), (33, 70), (97, 31), (64, 64), (5, 7)]


@pytest.mark.parametrize("degree", range(4))
def test_random_scenes(rasterize, degree):
    seed, (width, height) = degree % 2, SIZES[degree]
    size = (0.05, 0.1, 0.3)[degree % 3]
    view = camera(width, height, off_centre=(0.52, 0.47) if seed else (0.31, 0.72))
    assert_agrees(rasterize, scene(200, degree, 100 * seed + degree, size=size), view)


@pytest.mark.parametrize(
    "view",
    [
        camera(1, 1),
        camera(3, 200),
        camera(200, 3),
        *(camera(50, 40, fov=fov) for fov in (5.0, 150.0)),
        camera(50, 40, off_centre=(1.3, -0.2)),
    ],
)
def test_sizes_and_lenses(rasterize, view):
    """With the wide one, centres are far outside the image, where the Jacobian's ray is clamped."""
    assert_agrees(rasterize, scene(120, 1, 7, size=0.3), view, cut=0.05)


@pytest.mark.parametrize("near", [1e-6, 3.0])
def test_near_the_camera_plane(rasterize, near):
    """Centres just before, on and just beyond the near plane; those before it are not drawn."""
    view, unit = camera(40, 30), near / 0.01
    some = scene(60, 2, 3)
    z = torch.cat([torch.linspace(-0.05, 0.0099, 30), torch.linspace(0.0101, 0.05, 30)])
    sideways = torch.linspace(-1, 1, 60).roll(17)
    some["means"] = in_front(view, torch.stack([sideways * z, 0.3 * sideways.flip(0) * z, z], 1))
    view.viewmat[:3, 3] *= unit
    view = dataclasses.replace(view, near=near)
    some["means"] = some["means"] * unit
    depths = some["means"] @ view.viewmat[2, :3] + view.viewmat[2, 3]
    assert 20 <= (depths < near).sum() <= 40
    some["scales"] = some["scales"] * 0.02 * unit
    assert_agrees(rasterize, some, view, rows=depths >= near)


@pytest.mark.parametrize("saturated", [False, True])
def test_opaque_layers(rasterize, saturated):
    """Gaussians behind the end of a pixel are not drawn; at opacity 1 alpha is clamped and has no
    gradient.
    """
    some = scene(300 if saturated else 1500, 1, 0, size=1.0 if saturated else 0.3)
    some["opacities"] = torch.ones(300) if saturated else 0.9 + 0.1 * some["opacities"]
    assert_agrees(rasterize, some, camera(26, 19), cut=0.05 if saturated else ON_A_CUT)


@pytest.mark.parametrize(
    ("scales", "seed"),
    [((1.0, 1e-6, 1e-6), 0), ((0.3, 3e-7, 3e-7), 1), ((0.3, 0.3, 3e-7), 2)],
    ids=["needle", "short", "disc"],
)
def test_axis_ratio_of_a_million(rasterize, scales, seed):
    """Bounds of a needle are wider: its exponent is a small difference of terms of up to
    ``61^2 / (2 x 0.3) = 6,200``, each rounded by ``2^-24`` of itself in float32, in all by about
    1e-3.
    """
    some = scene(80, 1, seed)
    some["scales"] = torch.tensor(scales).repeat(80, 1)
    wider = {} if scales[1] > 1e-3 else {"image": 1e-3, "gradient": 1e-2}
    assert_agrees(rasterize, some, camera(), **wider)


@pytest.mark.parametrize(("axes", "length"), [(1, 1e-8), (3, 0.0), (3, 1e3), (1, 1e4)])
def test_extreme_scales(rasterize, axes, length):
    if axes == 1 and length >= 100 and getattr(rasterize, "looser", 1.0) > 1:
        pytest.skip("gsplat takes the determinant in float32, where that of such a needle cancels")
    some = scene(100, 1, 5)
    some["scales"][::30, :axes] = length
    some["quats"][::2] *= 1e12
    some["quats"][1::4] *= 1e-12
    assert_agrees(rasterize, some, camera(), image=IMAGE if axes == 3 or length < 1 else 1e-4)


def test_thousands_in_one_tile(rasterize):
    some = scene(20_000, 1, 2, size=0.02)
    some["means"] *= 0.5
    some["opacities"] = some["opacities"] * 0.02 + 1 / 255
    # So many alphas per pixel that a cut is nearby in most: look closer.
    assert_agrees(rasterize, some, camera(5, 4), cut=0.1, nudge=1e-5)


@pytest.mark.parametrize(
    ("scales", "screen_filter"),
    [
        (0.005, FILTERS["on"]),
        (0.02, FILTERS["mip"]),
        (0.02, ScreenFilter(variance=2.0)),
        ((1.0, 1e-6, 1e-6), FILTERS["on"]),
        ((0.3, 0.3, 3e-7), FILTERS["on"]),
    ],
    ids=str,
)
def test_screen_filters(rasterize, scales, screen_filter):
    """From a tenth of a pixel to several; needles, which have no area and are not drawn, and discs
    from the edge.
    """
    view, image, cut = camera(70, 50), IMAGE, 0.04
    some = scene(200, 1, 11, size=scales if isinstance(scales, float) else 1.0)
    if isinstance(scales, tuple):
        some = scene(80, 1, 3)
        view = camera()
        image = 3e-4
        cut = ON_A_CUT
        some["scales"] = torch.tensor(scales).repeat(80, 1)
    assert_agrees(rasterize, some, view, screen_filter=screen_filter, image=image, cut=cut)


def test_an_ellipse_beyond_the_range_of_integers(rasterize):
    """The centre is 1e12 pixels away, the long axis crosses the image; all pixels are finite and in
    range.
    """
    far = 1e8
    view = Camera(torch.eye(4), intrinsics(100.0, 100.0, 64, 64), 128, 128)
    some = scene(20, 0, 0)
    some["means"][:, 2] += 4
    some["means"][7] = torch.tensor([far, 0.0, 0.01])
    some["scales"][7] = torch.tensor([far, 1e-3, 1e-3])
    some["quats"][7] = torch.tensor([math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)])
    some["opacities"][7] = 0.9
    image, alpha = rasterize(**some, camera=view, background=BACKGROUND)
    assert (
        image.isfinite().all()
        and alpha.isfinite().all()
        and (alpha >= 0).all()
        and (alpha <= 1).all()
    )
