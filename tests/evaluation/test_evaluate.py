"""Rows of an evaluation, by hand and of an unadapted file; errors of levels: lengths by which a picture shifts."""

import math

import pytest
import torch

from clod_adapter import AttenuationConfig, Camera, ClodError, Gaussians, View, evaluate, render, with_dial
from clod_adapter.evaluation.level_errors import geometric_errors
from clod_adapter.io.formats.tileset import ALLOWED
from clod_adapter.losses import psnr_ssim
from scenes import camera, gaussians, in_front, photograph, ring


def row_of_four() -> Gaussians:
    """Four Gaussians at camera depths 1, 2, 4 and 8, the last far outside the image; sigma_d is 1."""
    means = in_front(camera(), torch.tensor([[0.0, 0, 1], [0, 0, 2], [0, 0, 4], [80, 0, 8]]))
    some = gaussians(4, 0, 0).replace(means=means, opacity_logits=torch.full((4,), 2.0))
    return with_dial(some, torch.ones(4), AttenuationConfig(tau=0.01, eps=0.0))


def test_counts_follow_the_culling_threshold() -> None:
    """Kept iff ``log a - (d s)^2 / 2 > log(tau s)`` with log a = -0.127: at s = 1 the two nearer than 3."""
    view = View(camera(), torch.zeros(45, 61, 3, dtype=torch.uint8))
    rows = evaluate(row_of_four(), [view, view], [1.0, 1.5, 3.0])
    assert [row.kept for row in rows] == [2, 1, 0]
    assert [row.kept_share for row in rows] == [0.5, 0.25, 0]
    assert [row.in_view for row in rows] == [2, 1, 0]
    (row,) = evaluate(row_of_four().replace(sigma_d=torch.full((4,), 1e3)), [view], [1.0])
    assert (row.kept, row.in_view) == (4, 3)
    assert rows[2].psnr == math.inf  # a black photograph of nothing


def test_rows_are_means_over_renders() -> None:
    sigma_d = torch.full((200,), 0.8, requires_grad=True)
    some = with_dial(gaussians(200, 1, 0), sigma_d, AttenuationConfig(scene_distance=4.0))
    views = photograph(gaussians(200, 1, 0), ring(3, 32, 24))
    seen = []
    rows = evaluate(some, views, [1.0, 2.0], progress=lambda now: seen.append((now.done, now.total)))
    assert seen == [(k, 6) for k in range(1, 7)]
    for row in rows:
        with torch.no_grad():
            renders = [render(some, view.camera, row.virtual_scale) for view in views]
        metrics = [psnr_ssim(r.image, view.image) for r, view in zip(renders, views, strict=True)]
        assert row.psnr == pytest.approx(sum(m[0] for m in metrics) / 3)
        assert row.ssim == pytest.approx(sum(m[1] for m in metrics) / 3)
        assert row.kept == pytest.approx(sum(int(r.kept.sum()) for r in renders) / 3)
        assert 0 < row.kept_share == row.kept / 200 < 1 and row.in_view < row.kept


def test_bad_calls_are_named() -> None:
    views = [View(camera(20, 16), torch.zeros(16, 20, 3, dtype=torch.uint8))]
    for given, dials, message in (
        ([], [1.0], "no held-out views"),
        (views, [], "no dial values"),
        (views, [1.0, -0.5], "virtual_scale is -0.5"),
        (views, [1.0, math.nan], "virtual_scale is nan"),
    ):
        with pytest.raises(ClodError, match=message):
            evaluate(row_of_four(), given, dials)


WIDTH, HEIGHT, FOCAL, DISTANCE = 96, 72, 90.0, 6.0


def smooth() -> Gaussians:
    """Wide Gaussians at one distance, so that a shift of the image is the same everywhere."""
    found = gaussians(40, 0, 3, size=0.3)
    means = found.means * torch.tensor([0.7, 0.5, 0.0]) + torch.tensor([0.0, 0.0, DISTANCE])
    return found.replace(means=means, opacity_logits=found.opacity_logits.clamp(-1, 2))


def view() -> Camera:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera(torch.eye(4), K, WIDTH, HEIGHT)


def test_a_shift_has_its_own_length() -> None:
    """Moved across by 0.4 pixels, seen from so far: pixels d / f, times what viewers allow."""
    finest, length = smooth(), 0.4 * DISTANCE / FOCAL
    moved = finest.replace(means=finest.means + torch.tensor([length, length, 0.0]) / 2**0.5)
    assert geometric_errors([finest, moved], [view()]) == pytest.approx([0, ALLOWED * length], rel=0.15)


def test_errors_ascend_and_grow_with_what_is_missing() -> None:
    """A level that happens to be nearer to the finest than the level before has that one's error."""
    finest = smooth()
    order = finest.opacity_logits.argsort(descending=True)
    half, few = finest[order[:20]], finest[order[:5]]
    errors = geometric_errors([finest, half, few, half], [view(), view()])
    assert 0 == errors[0] < errors[1] < errors[2] == errors[3]
