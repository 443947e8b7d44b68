"""The projection packs sixteen Gaussians at a time, tested with counts and visibility patterns around sixteen."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from backends import torch_threads
from clod_adapter.rasterizers import cpu, reference
from oracle import Parameters, assert_agrees, assert_same, differentiate, weights
from scenes import camera, in_front, scene

VIEW = camera(45, 37)


@pytest.fixture(params=[1, 3], autouse=True)
def threads(request: pytest.FixtureRequest) -> Iterator[None]:
    with torch_threads(request.param):
        yield


def all_visible(n: int, degree: int = 3) -> Parameters:
    """Translucent Gaussians in front of the camera, in the image."""
    some = scene(n, degree, n, size=0.15)
    g = torch.Generator().manual_seed(n)
    z = 2 + 2 * torch.rand(n, 1, generator=g)
    sideways = (torch.rand(n, 2, generator=g) - 0.5) * torch.tensor([0.9, 0.7])
    some["means"] = in_front(VIEW, torch.cat([sideways * z, z], 1))
    some["opacities"] = 0.1 + 0.3 * torch.rand(n, generator=g)
    return some


def hide(some: Parameters, gone: Tensor, how: str) -> None:
    """Makes rows invisible: culled by the projection, before it, or after it where their colour is not finite."""
    if how in ("behind", "beside"):
        place = [0.1, 0.2, -3.0] if how == "behind" else [30.0, 0.2, 3.0]
        some["means"][gone] = in_front(VIEW, torch.tensor([place])).expand(int(gone.sum()), 3)
    elif how == "faint":
        some["opacities"][gone] = 0.001
    else:
        values = some[how.split()[-1]].view(49, -1)
        column = -1 if how.startswith("last") else 0
        values[gone, column] = torch.tensor([math.nan, math.inf, -math.inf]).repeat(17)[:49][gone]


@pytest.mark.parametrize(("n", "degree"), [(0, 0), (1, 3), (15, 1), (16, 0), (16, 3), (17, 1), (33, 3)])
def test_all_visible(n: int, degree: int) -> None:
    some = all_visible(n, degree)
    seen = differentiate(reference.rasterize, {k: v.double() for k, v in some.items()}, VIEW, weights(VIEW))
    assert (seen.gradients["opacities"] != 0).all()  # all are visible
    assert_agrees(cpu.rasterize, some, VIEW)


ROWS = torch.arange(49)
PATTERNS = {
    "every other": ROWS % 2 == 0,
    "first": ROWS < 1,
    "first sixteen": ROWS < 16,
    "middle sixteen": (ROWS >= 16) & (ROWS < 32),
    "sixteen across": (ROWS >= 9) & (ROWS < 25),
    "second to last sixteen": (ROWS >= 32) & (ROWS < 48),
    "ends of sixteen": (ROWS == 15) | (ROWS == 16),
    "last": ROWS == 48,
    "all but the first": ROWS > 0,
    "all but the last": ROWS < 48,
    "all but one in the middle": ROWS != 24,
    "all": ROWS >= 0,
    "random": torch.rand(49, generator=torch.Generator().manual_seed(0)) < 0.5,
}


HOW = [["behind", "faint", "beside"], ["sh0", "first of shN", "last of shN"]]


@pytest.mark.parametrize(("pattern", "how"), [pair for some in HOW for pair in zip(PATTERNS, some * 5, strict=False)])
def test_invisible_rows_are_not_packed(pattern: str, how: str) -> None:
    """Rows whose colour is not finite are packed and removed again, beside others that the projection culls."""
    some, gone = all_visible(49), PATTERNS[pattern]
    hide(some, gone, how)
    behind = (ROWS % 7 == 3) & torch.tensor(how in HOW[1])
    hide(some, behind, "behind")
    assert_agrees(cpu.rasterize, some, VIEW, rows=~gone & ~behind)


def test_earlier_calls_do_not_change_the_result() -> None:
    """Records and lists are in recycled memory; after a larger scene with NaN the result has the same bits."""
    some = all_visible(17)
    want = differentiate(cpu.rasterize, some, VIEW, weights(VIEW))
    for n in (33, 100, 400):
        spoiled = all_visible(n)
        spoiled["sh0"][::2] = math.nan
        differentiate(cpu.rasterize, spoiled, VIEW, weights(VIEW))
        assert_same(differentiate(cpu.rasterize, some, VIEW, weights(VIEW)), want)
