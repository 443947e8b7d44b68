"""Nonfinite rows are found and named."""

from __future__ import annotations

import math

import pytest
import torch

from clod_adapter.errors import ClodError
from clod_adapter.finite import bad_gaussians, bad_rows, largest_colour, require_finite, spoilt_rows
from scenes import gaussians


@pytest.mark.parametrize(("shape", "bad"), [((7,), math.nan), ((7, 3), math.inf), ((7, 1, 3), -math.inf)])
def test_bad_rows(shape: tuple[int, ...], bad: float) -> None:
    values = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    assert bad_rows(values) is None and bad_rows(values[:0]) is None
    assert bad_rows(torch.full(shape, 3e38)) is None  # though their sum overflows
    values.view(7, -1)[2, 0], values.view(7, -1)[5, -1] = bad, -bad  # which cancel to NaN
    assert bad_rows(values).nonzero()[:, 0].tolist() == [2, 5]


def test_spoilt_rows_are_those_of_any_gradient() -> None:
    gradients = {"means": torch.ones(5, 3), "sigma": torch.ones(5), "sh0": torch.full((5, 1, 3), 3e38)}
    assert not spoilt_rows(gradients).any()
    gradients["means"][1, 2], gradients["sigma"][3] = math.nan, math.inf
    assert spoilt_rows(gradients).nonzero()[:, 0].tolist() == [1, 3]


def test_only_an_opacity_may_be_infinite() -> None:
    good = gaussians(6, 1, 0)
    logits = good.opacity_logits.clone()
    logits[:2] = torch.tensor([math.inf, -math.inf])
    assert bad_gaussians(good.replace(opacity_logits=logits)) == {}
    logits[3], means = math.nan, good.means.clone()
    means[4, 2] = math.inf
    found = bad_gaussians(good.replace(opacity_logits=logits, means=means))
    assert {name: rows.nonzero().item() for name, rows in found.items()} == {"means": 4, "opacity_logits": 3}
    with pytest.raises(ClodError, match=r"^it: means is not finite in 1 rows \(the first is 4\); mend it$"):
        require_finite(good.replace(means=means), "it", "mend it")


def test_the_largest_colour_is_named() -> None:
    one = gaussians(6, 1, 0)
    sh0, shN = one.sh0.clone(), one.shN.clone()
    sh0[1, 0, 2] = -500.0
    assert largest_colour(one.replace(sh0=sh0)) == "the largest sh0 is 500, in row 1: leave out such rows"
    shN[4, 0, 1] = 2e30
    assert "the largest shN is 2e+30, in row 4" in largest_colour(one.replace(sh0=sh0, shN=shN))
    assert "sh0 is 500" in largest_colour(one.replace(sh0=sh0, shN=shN[:, :0]))
