"""The equation at 50 digits with mpmath, the grid it is compared on, and random Gaussians for its properties."""

from __future__ import annotations

import itertools
import math
from functools import cache
from typing import NamedTuple

import mpmath
import torch
from hypothesis import settings
from hypothesis import strategies as st
from torch import Tensor

from clod_adapter.config import AttenuationConfig

DTYPES = [torch.float32, torch.float64]
LOGITS = [-200.0, -40.0, -6.0, -1.0, 0.0, 2.0, 9.0, 200.0, math.inf]
SIGMAS = [-1.0, 0.0, 1e-12, 1e-6, 1e-3, 0.05, 0.4, 1.0, 30.0, 1e6, 1e12]
DISTANCES = [0.0, 1e-7, 1e-3, 0.1, 0.7, 1.5]
SCALES = [1.0, 1.75, 7.0, 1e4]
TAUS = [1e-6, 1 / 255, 0.5]
EPSILONS = [0.0, 1e-8, 1e-2]

mpmath.mp.dps = 50
ZERO = mpmath.mpf(0)


def grid(*axes: list[float]) -> list[Tensor]:
    """Columns of the axes' product. Values are exact in float32, so both dtypes share one mpmath reference."""
    return list(torch.tensor(list(itertools.product(*axes)), dtype=torch.float32).double().unbind(1))


def assert_close(
    got: Tensor, want: list[mpmath.mpf], ulps: float | list[float], floor: float | list[float] = 0.0
) -> None:
    """Relative error within ulps * finfo.eps, absolute within floor or the smallest normal; too large means inf."""
    info = torch.finfo(got.dtype)
    ulps = ulps if isinstance(ulps, list) else [ulps] * len(want)
    floor = floor if isinstance(floor, list) else [floor] * len(want)
    for i, (g, w) in enumerate(zip(got.tolist(), want, strict=True)):
        if abs(w) > info.max:
            assert g == math.copysign(math.inf, w), (i, g, w)
        else:
            error = abs(mpmath.mpf(g) - w)
            assert error <= max(ulps[i] * info.eps * abs(w), info.tiny, floor[i]), (i, g, w)


class Reference(NamedTuple):
    """log factor and its slope by sigma, at 50 digits."""

    log_factor: mpmath.mpf
    slope: mpmath.mpf


@cache
def reference(sigma: float, d: float, s: float, eps: float) -> Reference:
    sigma_plus = max(mpmath.mpf(sigma), ZERO)
    v = sigma_plus**2 + mpmath.mpf(eps) / 2
    if d == 0:
        return Reference(ZERO, ZERO)
    if v == 0:
        return Reference(-mpmath.inf, ZERO)
    u = (mpmath.mpf(d) * s) ** 2 / (2 * v)
    return Reference(-u, 2 * u * sigma_plus / v)


def log_opacity(logit: float) -> mpmath.mpf:
    return ZERO if logit == math.inf else -mpmath.log1p(mpmath.exp(-mpmath.mpf(logit)))


@cache
def reference_extinction(logit: float, sigma: float, d: float, tau: float, eps: float) -> mpmath.mpf:
    upper = mpmath.exp(log_opacity(logit)) / mpmath.mpf(tau)
    v = max(mpmath.mpf(sigma), ZERO) ** 2 + mpmath.mpf(eps) / 2
    if d == 0:
        return upper
    if v == 0:
        return ZERO
    return upper * mpmath.exp(-mpmath.lambertw((upper * d) ** 2 / v).real / 2)


@cache
def reference_growth(h: float, d: float, s: float, r: float) -> tuple[mpmath.mpf, mpmath.mpf]:
    """``(log g, log m)`` without the clamp of g, at 50 digits."""
    log_m = max(mpmath.log(mpmath.mpf(d) * s / mpmath.mpf(r)), ZERO) if d else ZERO
    return h * log_m, log_m


def config(tau: float = 1 / 255, eps: float = 1e-8, **other: object) -> AttenuationConfig:
    return AttenuationConfig(tau=tau, eps=eps, **{"max_sv": 1.0} | other)


unit = st.floats(0, 1.5, width=32)
decay = st.one_of(st.floats(-1, 2, width=32), st.floats(0.0009765625, 1e6, width=32))
logit = st.floats(-30, 30, width=32)
dial = st.floats(1, 100)
rows = st.lists(st.tuples(logit, decay, unit), min_size=1, max_size=20)
epsilon = st.sampled_from(EPSILONS)
quick = settings(deadline=None, max_examples=50)


def columns(data: list[tuple[float, ...]], dtype: torch.dtype = torch.float64) -> list[Tensor]:
    return [torch.tensor(c, dtype=dtype) for c in zip(*data, strict=True)]
