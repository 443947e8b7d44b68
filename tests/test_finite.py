"""Nonfinite rows are found and named."""

from __future__ import annotations

import math

import pytest
import torch

from clod_adapter.errors import ClodError
from clod_adapter.finite import bad_gaussians, bad_rows, require_finite
from scenes import gaussians


@pytest.mark.parametrize(("shape", "bad"), [((7,), math.nan), ((7, 3), math.inf), ((7, 1, 3), -math.inf)])
def test_bad_rows(shape: tuple[int, ...], bad: float) -> None:
    values = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    assert bad_rows(values) is None and bad_rows(values[:0]) is None
    assert bad_rows(torch.full(shape, 3e38)) is None  # though their sum overflows
    values.view(7, -1)[2, 0], values.view(7, -1)[5, -1] = bad, -bad  # which cancel to NaN
    assert bad_rows(values).nonzero()[:, 0].tolist() == [2, 5]


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
