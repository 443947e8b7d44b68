"""The alignment of a checkpoint with its cameras: what fits, which frame is suggested, which screen
filter is found.
"""

import math
import re
from dataclasses import replace

import pytest
import torch

import scenes
from clod_adapter import Scene, View, evaluate, render
from clod_adapter.alignment.check import check_alignment, compare_filters
from clod_adapter.alignment.frames import NERFSTUDIO_TURNS, into_file, known_frames
from clod_adapter.alignment.search import guess_frame, scene_in
from clod_adapter.config import FILTERS
from scenes import gaussians, photograph, ring, seeded

EYE = torch.eye(3, dtype=torch.float64)
NONE = torch.zeros(3, dtype=torch.float64)
FLIP = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))


@pytest.fixture(scope="module")
def pair():
    base, scene = scenes.capture(n=250, views=8, width=60, height=44)
    return base, [*scene.test, *scene.train]


def posed(views, change):
    return [
        View(replace(view.camera, viewmat=change(view.camera.viewmat).float()), view.image)
        for view in views
    ]


def in_world(views, scale, rotation, offset):
    """The views in the world ``x' = scale rotation x + offset``, which is not the file's."""
    back = rotation.T, 1 / scale, -rotation.T @ offset / scale
    return posed(views, lambda pose: into_file(pose.double()[None], *back)[0])


def test_an_aligned_file_fits_under_any_exposure(pair):
    base, views = pair
    found = check_alignment(base, views)
    assert found.fits and not found.on_white and found.views == 8
    assert found.explained == 1
    assert found.correlation > 0.9
    assert found.margin > 6
    assert 0 < found.in_view <= 1
    darker = [View(view.camera, (view.image * 0.4).round().to(torch.uint8)) for view in views]
    assert check_alignment(base, darker).fits


def test_measures_match_their_definitions(pair):
    base, views = pair
    wrong = base.replace(means=base.means.roll(1, 1))
    found = check_alignment(wrong, views)
    renders = torch.stack([render(wrong, view.camera).image.clamp(0, 1) for view in views])
    photographs = torch.stack([view.image / 255 for view in views])
    constants = photographs.mean((1, 2), keepdim=True)
    for value, images in ((found.psnr, renders), (found.mean_colour_psnr, constants)):
        psnr = -10 * math.log10((images - photographs).square().mean())
        assert value == pytest.approx(psnr, abs=1e-4)
    a = (renders - renders.mean((1, 2), keepdim=True)).flatten()
    b = (photographs - constants).flatten()
    assert found.correlation == pytest.approx(float(a @ b / a.norm() / b.norm()), abs=1e-4)


MIRRORED = torch.diag(EYE.new_tensor([-1.0, 1, 1])) @ EYE[[1, 2, 0]]
BACKWARD = torch.diag(torch.tensor([1.0, -1, -1, 1]))
MOVED = EYE.new_tensor([3.0, -2, 1])
BACKWARD_POSES = "negate the y and z axes of their poses"
FRAMES = {
    "file's -y, z, x (mirrored)": lambda views: in_world(views, 1.0, MIRRORED, NONE),
    "4 times as large and moved by (": lambda views: in_world(views, 4.0, EYE, MOVED),
    BACKWARD_POSES: lambda views: posed(views, lambda pose: BACKWARD @ pose),
    "and invert them": lambda views: posed(views, lambda pose: torch.linalg.inv(pose) @ BACKWARD),
}


def rounded(number):
    """The number to two digits; the search is accurate to about a per cent."""
    return f"{float(f'{float(number[0]):.2g}'):g}"


@pytest.mark.parametrize("says", FRAMES)
def test_another_frame_is_named(pair, says):
    base, views = pair
    elsewhere = FRAMES[says](views)
    found = check_alignment(base, elsewhere)
    guess = guess_frame(base, elsewhere, found)
    assert not found.fits

    assert guess.psnr > found.mean_colour_psnr + 3
    assert guess.clear
    assert says in re.sub(r"-?\d+(\.\d+)?", rounded, guess.frame.description)
    back = scene_in(Scene(tuple(elsewhere), ()), guess.frame)
    assert check_alignment(base, back.train).psnr > check_alignment(base, views).psnr - 1


def test_frames_of_trainers(pair):
    _, views = pair
    viewmats = torch.stack(
        [v.camera.viewmat.double() for v in in_world(views, 3.0, FLIP, NONE + 2)]
    )
    points = torch.randn(500, 3, generator=seeded(1)) * torch.tensor([1.0, 5, 2]) + 3
    frames = known_frames(viewmats, points)
    # nerfstudio's: the cameras' mean is the origin, their mean up is z, and their farthest
    # coordinate is 1.
    of_nerfstudio = [frame for frame in frames if "nerfstudio" in frame.description]
    assert len(of_nerfstudio) == len(NERFSTUDIO_TURNS)
    for frame in of_nerfstudio:
        poses = torch.linalg.inv(frame.of(viewmats))
        assert poses[:, :3, 3].mean(0).abs().max() < 1e-6
        assert poses[:, :3, 3].abs().max() == pytest.approx(1, abs=1e-6)
        up = -poses[:, :3, 1].mean(0)
        assert up[:2].abs().max() < 1e-6 < up[2]
    # gsplat's: the points' median is near the origin and their principal axes are the axes, the
    # longest first.
    of_gsplat = [frame for frame in frames if "gsplat" in frame.description]
    assert len(of_gsplat) == 5  # without the points, and with each sign of their axes
    for frame in of_gsplat[1:]:
        moved = (points.double() - frame.offset) @ frame.rotation / frame.scale
        assert torch.linalg.det(frame.rotation) == pytest.approx(1)
        # to what a median per axis changes in a turn
        assert moved.quantile(0.5, dim=0).abs().max() < 0.02
        spread = moved.T.cov()
        assert (spread - torch.diag(spread.diag())).abs().max() < 1e-6 * spread.max()
        assert spread.diag().tolist() == sorted(spread.diag().tolist(), reverse=True)


def seen_with(name, views=5):
    """A checkpoint that names no filter, and photographs of it drawn with ``name``: of Gaussians of
    a pixel at most.
    """
    fine = gaussians(1500, 0, 0, size=0.025)
    noisy = fine.sh0 + 0.1 * torch.randn(fine.sh0.shape, generator=seeded(1))
    return fine.replace(sh0=noisy), photograph(
        fine.replace(screen_filter=FILTERS[name]), ring(views, 48, 36)
    )


@pytest.mark.parametrize("name, expected", [("off", "on"), ("on", "mip"), ("mip", "off")])
def test_the_filter_of_the_photographs_is_found(name, expected):
    base, views = seen_with(name)
    chosen, psnr = compare_filters(base, views, expected)
    (row,) = evaluate(base.replace(screen_filter=FILTERS["mip"]), views, [1.0])
    assert psnr["mip"] == pytest.approx(row.psnr, abs=1e-3)
    assert chosen == name == max(psnr, key=psnr.__getitem__) and psnr.keys() == FILTERS.keys()


def test_expected_filter_is_kept_without_a_clear_difference():
    """The Gaussians are so large that filters hardly change them."""
    truth = gaussians(100, 0, 2, size=0.4)
    views = photograph(truth.replace(screen_filter=FILTERS["on"]), ring(4, 48, 36))
    base = truth.replace(sh0=truth.sh0 + 0.05)
    assert all(compare_filters(base, views, expected)[0] == expected for expected in FILTERS)


def test_a_filter_must_be_better_in_most_views():
    """Two of five photographs have another filter, which is better in the mean but not in most
    views.
    """
    base, classic = seen_with("off")
    _, other = seen_with("on")
    few = [*classic[:3], *(View(view.camera, view.image) for view in other[3:])]
    assert compare_filters(base, few[3:])[0] == "on" and compare_filters(base, few)[0] == "off"
