"""Compiled functions against plain ones in float64: the elementary functions, and the count term."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from backends import torch_threads
from clod_adapter._kernels.elementary import exp2, log2
from clod_adapter._kernels.simd import load, store
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.training.target_count import TargetShare, count_gradient

CONFIG = AdaptConfig(max_sv=7.0)


@settings(deadline=None, max_examples=30)
@given(
    n=st.sampled_from([1, 15, 16, 17, 33, 400]), s=st.sampled_from([1.0, 2.5, 10.0]), seed=st.integers(0, 99),
    share=st.sampled_from([0.02, 0.4, 1.0]), eps=st.sampled_from([0.0, 1e-8]), workers=st.sampled_from([1, 3]),
)  # fmt: skip
def test_both_forms_agree(n: int, s: float, seed: int, share: float, eps: float, workers: int) -> None:
    random = torch.Generator().manual_seed(seed)
    logits, d = 4 * torch.randn(n, generator=random), 2 * torch.rand(n, generator=random)
    sigma = 2 * torch.rand(n, generator=random) + 1e-3
    dial, target = AttenuationConfig(eps=eps, max_sv=10.0), TargetShare(share, 1 / share)
    with torch_threads(workers):
        got = count_gradient(d, logits, sigma, s, dial, 0.1, CONFIG, target)
    exact = (x.double() for x in (d, logits, sigma))
    want = count_gradient(*exact, s, dial, 0.1, CONFIG, target)
    torch.testing.assert_close(got.double(), want, rtol=1e-4, atol=1e-6 * max(float(want.abs().max()), 1e-9))


@pytest.mark.parametrize("logit", [-math.inf, -200.0, 200.0, math.inf])
def test_extreme_opacities_are_finite(logit: float) -> None:
    d, sigma = torch.tensor([0.0, 1e-6, 1.0, 1e6]).repeat(8), torch.tensor([1e-4, 1.0, 1e9, 1e-4]).repeat_interleave(8)
    logits = torch.full_like(d, logit)
    for target in (0.01, 1.0):
        given = count_gradient(d, logits, sigma, 3.0, AttenuationConfig(), 0.1, CONFIG, TargetShare(target, 1.0))
        assert given.isfinite().all()


@njit
def elementary(function, x, out):
    for at in range(0, len(x), 16):
        store(out, at, exp2(load(x, at)) if function == 0 else log2(load(x, at)))


def test_errors_of_exp2_and_log2() -> None:
    """Of exp2 relative, over what blending needs, [-126, 0], and above. Of log2 absolute, beside one and a half units
    of the result (tests/other_libm); for every fifth mantissa of two octaves and all normal exponents."""
    some = np.concatenate([np.linspace(-126, 127, 1_000_001), -np.logspace(-30, 2.1, 100_001)]).astype(np.float32)
    octaves = np.float32(0.5).view(np.uint32) + np.arange(0, 1 << 24, 5, dtype=np.uint32)
    every = np.arange(0x00800000, np.float32(3.4e38).view(np.uint32), 997, dtype=np.uint32)
    inputs = some[some >= -126], np.concatenate([octaves, every]).view(np.float32)
    for function, (x, exact) in enumerate(zip(inputs, (np.exp2, np.log2), strict=True)):
        x = np.resize(x, -(-len(x) // 16) * 16)  # whole vectors
        found, want = np.empty_like(x), exact(x.astype(np.float64))
        elementary(function, x, found)
        errors, units = np.abs(found - want), np.spacing(np.abs(want).astype(np.float32))
        assert (errors / want < 3e-7).all() if function == 0 else (errors - 1.5 * units < 1e-7).all()
