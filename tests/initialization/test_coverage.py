"""Coverage of an image by each Gaussian."""

from __future__ import annotations

from dataclasses import replace

import torch

from clod_adapter.initialization.importance import SMALLER, coverage, reduced
from clod_adapter.render import render
from scenes import capture


def test_coverage_sums_to_alpha() -> None:
    """Coverage is 0 for Gaussians that no pixel shows."""
    base, scene = capture()
    camera = scene.train[0].camera
    shown = coverage(base, base.opacities, camera)
    torch.testing.assert_close(shown.sum(), render(base, camera).alpha.sum(), rtol=1e-4, atol=0)
    behind = replace(camera, viewmat=torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ camera.viewmat)
    assert bool((shown >= 0).all()) and float(coverage(base, base.opacities, behind).sum()) < 0.2 * float(shown.sum())


def test_a_reduced_view_shows_the_same() -> None:
    base, scene = capture()
    camera = scene.train[0].camera
    whole, small = (coverage(base, base.opacities, each) for each in (camera, reduced(camera)))
    assert (reduced(camera).width, reduced(camera).height) == (camera.width // SMALLER, camera.height // SMALLER)
    assert float((whole / whole.sum() - small / small.sum()).abs().sum()) < 0.2
