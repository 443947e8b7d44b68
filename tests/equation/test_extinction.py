"""The extinction scale and its inverse against mpmath, and against each other."""

from __future__ import annotations

import mpmath
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from clod_adapter.equation.attenuation import SIGMA_MAX, attenuate
from clod_adapter.equation.extinction import extinction_scale, sigma_for_extinction
from exact import (
    DISTANCES,
    DTYPES,
    EPSILONS,
    LOGITS,
    SIGMAS,
    TAUS,
    ZERO,
    assert_close,
    columns,
    config,
    dial,
    epsilon,
    grid,
    log_opacity,
    quick,
    reference_extinction,
    rows,
)

# Each eps, each tau and both types: pairs.
PAIRS = pytest.mark.parametrize(
    ("eps", "tau", "dtype"),
    [(eps, tau, DTYPES[(i + j) % 2]) for i, eps in enumerate(EPSILONS) for j, tau in enumerate(TAUS)],
)


@PAIRS
def test_extinction_scale_matches_mpmath(dtype: torch.dtype, eps: float, tau: float) -> None:
    inputs = grid(LOGITS, SIGMAS, DISTANCES)
    logits, sigma, d = (t.to(dtype) for t in inputs)
    got = extinction_scale(logits, sigma, d, config(tau, eps))
    rows = list(zip(*(c.tolist() for c in inputs), strict=True))
    want = [reference_extinction(*row, tau, eps) for row in rows]
    allowed = [6 + float(abs(log_opacity(row[0])) + abs(mpmath.log(tau))) for row in rows]
    assert_close(got, want, allowed, floor=torch.finfo(dtype).tiny / tau)


@PAIRS
def test_sigma_for_extinction_matches_mpmath(dtype: torch.dtype, eps: float, tau: float) -> None:
    inputs = grid(LOGITS[2:], DISTANCES, [0.0, 1e-6, 0.3, 1.0, 1.75, 1.999, 6.0, 100.0, 1e4])
    got = sigma_for_extinction(*(t.to(dtype) for t in inputs), config(tau, eps)).double()
    info = torch.finfo(dtype)
    for row, g in zip(zip(*(c.tolist() for c in inputs), strict=True), got.tolist(), strict=True):
        logit, d, s = row
        drop = log_opacity(logit) - mpmath.log(tau * mpmath.mpf(s)) if s > 0 else mpmath.inf
        if abs(drop) < 1e-14:
            continue  # s* is a/tau to rounding: both answers are right
        if drop < 0:
            assert g == float(torch.tensor(SIGMA_MAX, dtype=dtype)), row
            continue
        total = (mpmath.mpf(d) * s) ** 2 / (2 * drop)
        want = min(mpmath.sqrt(max(total - mpmath.mpf(eps) / 2, ZERO)), mpmath.mpf(SIGMA_MAX))
        # In float64, but for the last rounding: its condition is nothing beside float32's eps.
        logs = abs(log_opacity(logit)) + abs(mpmath.log(tau * mpmath.mpf(s))) + 1 if s > 0 else ZERO
        condition = 4 + float(logs / drop) * torch.finfo(torch.float64).eps / info.eps
        error = abs(mpmath.mpf(g) ** 2 - want**2)
        assert error <= condition * info.eps * max(total, mpmath.mpf(eps) / 2) + info.tiny, (row, g, want)


@given(rows, epsilon, st.sampled_from(TAUS[1:]), dial)
@quick
def test_kept_until_the_extinction_scale(data: list[tuple[float, ...]], eps: float, tau: float, scale: float) -> None:
    inputs = columns(data)
    chosen = config(tau, eps)
    culled_at = extinction_scale(*inputs, chosen)
    kept = attenuate(*inputs, scale, chosen).keep
    clear = (culled_at / scale - 1).abs() > 1e-12
    assert torch.equal(kept[clear], (scale < culled_at)[clear])
    for row, s in zip(data, culled_at.tolist(), strict=True):
        one = columns([row])
        if s * (1 - 1e-12) >= 1:
            assert attenuate(*one, s * (1 - 1e-12), chosen).keep.all()
            assert not attenuate(*one, s * (1 + 1e-12), chosen).keep.any()
