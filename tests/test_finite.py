"""Nonfinite rows are found and named."""

from __future__ import annotations

import math
import re

import pytest
import torch

from clod_adapter.errors import ClodError
from clod_adapter.finite import require_finite
from scenes import gaussians


def test_only_an_opacity_may_be_infinite() -> None:
    good = gaussians(6, 1, 0)
    good.opacity_logits[:2] = torch.tensor([math.inf, -math.inf])
    good.sh0[:] = 3e38  # whose sum overflows
    require_finite(good, "it", "mend it")
    for name, values in good.tensors().items():
        for bad in (math.nan,) if name == "opacity_logits" else (math.nan, math.inf):
            spoilt = values.clone()
            spoilt.view(6, -1)[2, 0], spoilt.view(6, -1)[5, -1] = bad, -bad  # which cancel to NaN
            said = f"it: {name} is not finite in 2 rows (the first is 2); mend it"
            with pytest.raises(ClodError, match=f"^{re.escape(said)}$"):
                require_finite(good.replace(**{name: spoilt}), "it", "mend it")
