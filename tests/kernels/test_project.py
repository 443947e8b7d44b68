"""The projection packs sixteen Gaussians at a time: every way in which sixteen can be incomplete."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from clod_adapter.rasterizers import cpu, reference
from oracle import BACKGROUND, Parameters, assert_agrees, assert_same, differentiate, weights
from scenes import camera, in_front, scene

VIEW = camera(45, 37)
COUNTS = [0, 1, 15, 16, 17, 33]


@pytest.fixture(params=[1, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def all_visible(n: int, degree: int = 3) -> Parameters:
    """Translucent, before the camera, in the image."""
    some = scene(n, degree, n, size=0.15)
    g = torch.Generator().manual_seed(n)
    z = 2 + 2 * torch.rand(n, 1, generator=g)
    sideways = (torch.rand(n, 2, generator=g) - 0.5) * torch.tensor([0.9, 0.7])
    some["means"] = in_front(VIEW, torch.cat([sideways * z, z], 1))
    some["opacities"] = 0.1 + 0.3 * torch.rand(n, generator=g)
    return some


def hide(some: Parameters, gone: Tensor, how: str) -> None:
    """Rows that go through the projection and are not found, or that do not even reach it."""
    if how == "behind":
        some["means"][gone] = in_front(VIEW, torch.tensor([[0.1, 0.2, -3.0]])).expand(int(gone.sum()), 3)
    elif how == "beside":
        some["means"][gone] = in_front(VIEW, torch.tensor([[30.0, 0.2, 3.0]])).expand(int(gone.sum()), 3)
    else:
        some["opacities"][gone] = 0.001


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("n", COUNTS)
def test_all_visible(threads: int, n: int, degree: int) -> None:
    some = all_visible(n, degree)
    seen = differentiate(reference.rasterize, {k: v.double() for k, v in some.items()}, VIEW, weights(VIEW))
    assert (seen.gradients["opacities"] != 0).all()  # the scene is what it says
    assert_agrees(cpu.rasterize, some, VIEW)


@pytest.mark.parametrize("how", ["behind", "beside", "faint"])
@pytest.mark.parametrize("n", COUNTS)
def test_all_invisible(threads: int, n: int, how: str) -> None:
    some = all_visible(n)
    hide(some, torch.ones(n, dtype=torch.bool), how)
    found = differentiate(cpu.rasterize, some, VIEW, weights(VIEW))
    assert torch.equal(found.image, BACKGROUND.expand(VIEW.height, VIEW.width, 3)) and (found.alpha == 0).all()
    for name in some:
        assert (found.gradients[name] == 0).all(), name


ROWS = torch.arange(49)
PATTERNS = {
    "every other": ROWS % 2 == 0,
    "first sixteen": ROWS < 16,
    "middle sixteen": (ROWS >= 16) & (ROWS < 32),
    "second to last sixteen": (ROWS >= 32) & (ROWS < 48),
    "last": ROWS == 48,
    "all but the first": ROWS > 0,
    "all but the last": ROWS < 48,
    "all but one in the middle": ROWS != 24,
    "all but sixteen across": (ROWS < 9) | (ROWS >= 25),
    "random": torch.rand(49, generator=torch.Generator().manual_seed(0)) < 0.5,
}


@pytest.mark.parametrize("how", ["behind", "faint"])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_some_invisible(threads: int, pattern: str, how: str) -> None:
    some, gone = all_visible(49), PATTERNS[pattern]
    hide(some, gone, how)
    assert_agrees(cpu.rasterize, some, VIEW, rows=~gone)


NOT_FINITE = {
    "first": [0], "middle": [7], "last of sixteen": [15], "ends": [0, 15], "first sixteen": [*range(16)],
    "across": [*range(9, 25)], "second sixteen": [*range(16, 32)], "last": [32], "all but the last": [*range(32)],
    "all but the middle": [*range(16), *range(17, 33)], "every other": [*range(0, 33, 2)], "all": [*range(33)],
}  # fmt: skip


@pytest.mark.parametrize("name", ["sh0", "first of shN", "last of shN"])
@pytest.mark.parametrize("where", NOT_FINITE)
def test_colors_that_are_not_finite(threads: int, where: str, name: str) -> None:
    """They are found, packed, and taken out again."""
    some, kept = all_visible(33), torch.ones(33, dtype=torch.bool)
    kept[NOT_FINITE[where]] = False
    values = some[name.split()[-1]].view(33, -1)
    column = -1 if name.startswith("last") else 0
    values[~kept, column] = torch.tensor([math.nan, math.inf, -math.inf]).repeat(11)[~kept]
    assert_agrees(cpu.rasterize, some, VIEW, rows=kept)


@pytest.mark.parametrize("n", [15, 16, 17, 33])
def test_colors_that_are_not_finite_in_smaller_and_larger_groups(threads: int, n: int) -> None:
    """Among others that are not seen, at the first row and at the last."""
    some = all_visible(n)
    gone = torch.arange(n) % 3 == 1
    hide(some, gone, "behind")
    some["sh0"][[0, n - 1], 0, 1] = math.nan
    gone[[0, n - 1]] = True
    assert_agrees(cpu.rasterize, some, VIEW, rows=~gone)


def test_what_earlier_calls_left_behind_plays_no_part() -> None:
    """Records and lists are in memory that is used again: a larger scene with NaN before, the same bits after."""
    some = all_visible(17)
    want = differentiate(cpu.rasterize, some, VIEW, weights(VIEW))
    for n in (33, 100, 400):
        spoiled = all_visible(n)
        spoiled["sh0"][::2] = math.nan
        differentiate(cpu.rasterize, spoiled, VIEW, weights(VIEW))
        assert_same(differentiate(cpu.rasterize, some, VIEW, weights(VIEW)), want)
