"""Measurements of a plan, on scenes with known results."""

from __future__ import annotations

import math

import pytest
import torch

from clod_adapter.cameras import Scene
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import removal_error
from clod_adapter.render import render
from clod_adapter.training import ablation
from clod_adapter.training.ablation import largest_change, needed_share, seen, sh_degree_losses
from scenes import gaussians, photograph, ring

LIMIT = 0.02


def with_bands(base: Gaussians, *sizes: float) -> Gaussians:
    """``base`` with harmonics of degree 3, each degree of the given size."""
    random = torch.Generator().manual_seed(5)
    bands = [size * torch.randn(len(base), 2 * d + 1, 3, generator=random) for d, size in enumerate(sizes, 1)]
    return base.replace(shN=torch.cat(bands, 1))


def test_sh_degree_losses_separate_used_from_unused_degrees() -> None:
    truth, cameras = with_bands(gaussians(200, 0, 3), 0.3, 1e-4, 1e-5), ring(4, 48, 36)
    views = photograph(truth, cameras)
    found = list(sh_degree_losses(truth, views, LIMIT))
    assert [degree for degree, _ in found] == [3, 2, 1]
    assert found[0][1] < LIMIT and found[1][1] < LIMIT and found[2][1] > 1
    # From where one matters on, nothing below it is looked at: whether its removal does harm or good.
    strong = with_bands(truth, 0.3, 1e-4, 0.3)
    for photographs in (photograph(strong, cameras), views):
        ((degree, loss),) = sh_degree_losses(strong, photographs, LIMIT)
        assert degree == 3 and loss > 1
    # A view that gains makes up for none that loses.
    mixed = (*photograph(strong, cameras[:2]), *photograph(strong.without_bands(2), cameras[2:]))
    ((_, change),) = sh_degree_losses(strong, mixed, LIMIT)
    of_each = [loss for view in mixed for _, loss in sh_degree_losses(strong, [view], LIMIT)]
    assert change == pytest.approx(sum(of_each) / 4) and min(of_each) > 1


def test_empty_sh_degrees_lose_nothing(captured: tuple[Gaussians, Scene], monkeypatch: pytest.MonkeyPatch) -> None:
    base, scene = captured
    assert dict(sh_degree_losses(with_bands(base, 0.3, 0, 0), scene.train, LIMIT)).keys() == {1, 2, 3}
    monkeypatch.setattr(ablation, "render", lambda *_: pytest.fail("rendered for nothing"))
    assert list(sh_degree_losses(with_bands(base, 0, 0, 0), scene.train, LIMIT)) == [(3, 0.0), (2, 0.0), (1, 0.0)]
    assert list(sh_degree_losses(base.without_bands(0), scene.train, LIMIT)) == []


def hidden() -> tuple[Gaussians, Scene, torch.Tensor]:
    """An opaque shell with Gaussians inside, some outside every image, some too faint, and others around it.

    Also ``[N]`` bool: the Gaussians whose removal alone changes an image.
    """
    base = gaussians(70, 1, 2, size=0.1)
    means, logs, logits = base.means, base.log_scales, base.opacity_logits
    around = 2 * math.pi * torch.arange(24) / 24
    means[:24] = torch.stack([around.sin(), torch.zeros(24), around.cos()], 1)
    logs[:24], logits[:24] = math.log(0.8), 9.0
    means[24:32], logs[24:32] = 0.05 * means[24:32], math.log(0.02)
    means[32:40] += torch.tensor([0.0, 80.0, 0.0])
    logits[40:46] = -8.0
    views, matters = photograph(base, ring(6, 40, 30)), torch.zeros(70, dtype=torch.bool)
    for camera in (view.camera for view in views):
        image = render(base, camera).image
        for row in range(70):
            matters[row] |= not torch.equal(image, render(base.select(torch.arange(70) != row), camera).image)
    return base, Scene(views, ()), matters


@pytest.mark.parametrize("first", [6, 2])
def test_seen_gaussians_change_a_pixel_when_removed(first: int) -> None:
    """The result does not depend on which views the error is from."""
    base, scene, matters = hidden()
    told: list[tuple[int, int]] = []
    error = removal_error(base, scene.train[:first])
    found = seen(base, scene.train[first:], error, 0, lambda now: told.append((now.done, now.total)))
    assert found.tolist() == matters.tolist()
    assert not found[24:46].any() and found[:24].all() and found[46:].any()
    assert first > 2 or ((error > 0).sum() < found.sum() and told == [(k, 4) for k in range(1, 5)])
    change, lost = largest_change(base, base.select(found), scene.train)
    assert change < 1e-6 and abs(lost) < 1e-6  # all of them at once, too
    # One opaque all over: its alpha is clamped in every pixel and has no derivative, and the image is all its own.
    base.means[0], base.log_scales[0], base.opacity_logits[0] = 0.0, math.log(100.0), math.inf
    views = photograph(base, ring(3, 40, 30))
    error = removal_error(base, views)
    assert error[0] == 0 and largest_change(base, base.select(torch.arange(70) > 0), views)[0] > 0.1
    assert seen(base, views, error, seed=0)[0]


def test_largest_change(captured: tuple[Gaussians, Scene]) -> None:
    base, scene = captured
    assert largest_change(base, base, scene.train) == (0.0, 0.0)
    less = base.select(torch.arange(len(base)) % 2 == 0)
    change, lost = largest_change(base, less, scene.train[:1])
    with torch.no_grad():
        images = [render(g, scene.train[0].camera).image.clamp(0, 1) for g in (base, less)]
    assert change == float((images[0] - images[1]).abs().max()) > 0.1 and lost > 1


def test_needed_share_is_that_of_the_visible_gaussians() -> None:
    """A quarter is too faint to matter; the others are all needed, also against the base's own renderings."""
    truth, cameras = gaussians(200, 2, 0), ring(4, 48, 36)
    faint = torch.arange(200) < 50
    base = truth.replace(opacity_logits=torch.where(faint, -9.0, 2.0))
    views = photograph(base, cameras)
    error = removal_error(base, views)
    share, loss = needed_share(base, views, error, LIMIT)
    assert 0.6 < share <= 0.76 and 0 <= loss < LIMIT
    assert needed_share(base, views, error, 3.0)[0] < share
    opaque = base.replace(opacity_logits=torch.full((200,), -9.0))
    assert needed_share(opaque, views, error, LIMIT)[0] == 0.51
