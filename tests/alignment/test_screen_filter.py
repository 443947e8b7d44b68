"""The screen filter of a checkpoint is recognised by its photographs."""

from __future__ import annotations

import pytest
import torch

from clod_adapter.alignment.screen_filter import compare_filters
from clod_adapter.cameras import View
from clod_adapter.config import FILTERS
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.gaussians import Gaussians
from scenes import gaussians, photograph, ring


def seen_with(name: str, views: int = 5) -> tuple[Gaussians, tuple[View, ...]]:
    """A checkpoint that does not name its filter, and photographs of it drawn with ``name``.

    Its Gaussians are at most a pixel wide in images of 48 pixels, where filters differ.
    """
    fine = gaussians(1500, 0, 0, size=0.025)
    noisy = fine.sh0 + 0.1 * torch.randn(fine.sh0.shape, generator=torch.Generator().manual_seed(1))
    return fine.replace(sh0=noisy), photograph(fine.replace(screen_filter=FILTERS[name]), ring(views, 48, 36))


@pytest.mark.parametrize(("name", "expected"), [("off", "on"), ("on", "mip"), ("mip", "off")])
def test_the_filter_of_the_photographs_is_found(name: str, expected: str) -> None:
    base, views = seen_with(name)
    found = compare_filters(base, views, expected)
    (row,) = evaluate(base.replace(screen_filter=FILTERS["mip"]), views, [1.0])
    assert found.psnr["mip"] == pytest.approx(row.psnr, abs=1e-3)
    assert (found.chosen, found.expected, found.screen_filter) == (name, expected, FILTERS[name])
    assert max(found.psnr, key=found.psnr.__getitem__) == name and found.psnr.keys() == FILTERS.keys()


def test_expected_filter_is_kept_without_a_clear_difference() -> None:
    """The Gaussians are so large that filters hardly change them."""
    truth = gaussians(100, 0, 2, size=0.4)
    views = photograph(truth.replace(screen_filter=FILTERS["on"]), ring(4, 48, 36))
    base = truth.replace(sh0=truth.sh0 + 0.05)
    for expected in FILTERS:
        assert compare_filters(base, views, expected).chosen == expected


def test_a_filter_must_be_better_in_most_views() -> None:
    """Two of five photographs have another filter, which is better in the mean but not in most views."""
    base, classic = seen_with("off")
    _, other = seen_with("on")
    few = [*classic[:3], *(View(view.camera, view.image) for view in other[3:])]
    alone = compare_filters(base, few[3:])
    assert alone.chosen == "on" and compare_filters(base, few).chosen == "off"
