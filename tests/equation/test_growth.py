"""Growth against mpmath and finite differences, its properties, and that nothing but the scales depends on it."""

from __future__ import annotations

import itertools
import math

import mpmath
import pytest
import torch
from torch import Tensor

from clod_adapter.adapter import with_dial
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate, dial
from clod_adapter.equation.growth import LOG_GROWTH_MAX, growth_factors
from clod_adapter.equation.units import in_world_units, with_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from exact import DISTANCES, DTYPES, SCALES, ZERO, assert_close, config, grid, reference_growth
from scenes import camera, gaussians

EXPONENTS = [-300.0, -1.0, -0.3, 0.0, 1e-6, 0.5, 0.75, 1.0, 3.0, 17.0]
REACHES = [1e-3, 0.3, 1.0, 4.2]


def bound(h: float, log_m: mpmath.mpf) -> float:
    """Of the docstring of ``growth``, in finfo.eps."""
    return 4 + 2 * abs(h) * (1 + float(log_m))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("scale", "reach"), [*zip(SCALES, REACHES, strict=True), (7.0, 1e-3)])
def test_factors_and_their_slopes_match_mpmath(dtype: torch.dtype, scale: float, reach: float) -> None:
    h, d = (column.to(dtype) for column in grid(EXPONENTS, [*DISTANCES, 1.0000001, 5e3]))
    h.requires_grad_()
    out = growth_factors(h, d, scale, reach)
    (slope,) = torch.autograd.grad(out.sum(), h)
    want, slopes, allowed, of_slopes = [], [], [], []
    for a, b in zip(h.tolist(), d.tolist(), strict=True):
        log_g, log_m = reference_growth(a, b, scale, reach)
        clamped = min(max(log_g, -LOG_GROWTH_MAX), LOG_GROWTH_MAX)
        want.append(mpmath.exp(clamped))
        slopes.append(mpmath.exp(log_g) * log_m if clamped == log_g else ZERO)
        allowed.append(bound(a, log_m))
        of_slopes.append(bound(a, log_m) + 2 / max(float(log_m), 1e-9))
    assert_close(out.detach(), want, allowed)
    assert_close(slope, slopes, of_slopes)
    assert sum(g > 1 for g in want) > 5


@pytest.mark.parametrize("dtype", DTYPES)
def test_edges_are_finite(dtype: torch.dtype) -> None:
    """At any finite exponent, at the centre, at distances and dial values whose product overflows."""
    largest = torch.finfo(dtype).max
    edges = itertools.product([0.0, -0.0, 1e-30, 1.0, -1.0, largest, -largest], [0.0, 1e-40, 1.0, 1e30, largest])
    h, d = torch.tensor([*edges], dtype=dtype).unbind(1)
    h.requires_grad_()
    for s, r in itertools.product([1.0, 5.0, 1e39, 1e300], [1e-300, 1e-3, 1.0, 1e300]):
        out = growth_factors(h, d, s, r)
        (slope,) = torch.autograd.grad(out.sum(), h)
        assert out.isfinite().all() and slope.isfinite().all()
        assert (out >= 0.99 * math.exp(-20)).all() and (out <= 1.01 * math.exp(20)).all()
        assert (out[(h == 0) | (d == 0)] == 1).all()


def test_growth_needs_a_dial_and_one_shape() -> None:
    three = torch.ones(3)
    assert attenuate(three, None, three, 2.0, None, growth_d=three).growth.tolist() == [1, 1, 1]
    with pytest.raises(ClodError, match=r"growth_d \(4,\)"):
        attenuate(three, three, three, 2.0, config(), growth_d=torch.ones(4))
    with pytest.raises(ClodError, match=r"growth_d \(1,\)"):
        attenuate(three, three, (torch.ones(3, 3), camera()), 2.0, config(), growth_d=torch.ones(1))


@pytest.mark.parametrize("normalizer", ["scene", "max", "quantile"])
@pytest.mark.parametrize(("unit", "known"), [(1.0, 0.0), (1.0, 2.5), (3.7, 0.0), (3.7, 2.5)])
def test_changing_the_unit_keeps_growth(normalizer: str, unit: float, known: float) -> None:
    settings = AttenuationConfig(normalizer=normalizer, scene_distance=unit, reference_distance=known)
    some = with_dial(gaussians(200, 0, 1), torch.linspace(0.1, 3, 200), settings)
    some = some.replace(growth_d=torch.linspace(-1, 3, 200))

    def factors(given: Gaussians) -> Tensor:
        return dial(given, camera(), 4.0).growth

    want = factors(some)
    assert want.max() > 2
    for other in (
        with_distance(some, 9.1), in_world_units(some), in_world_units(with_distance(some, 9.1)),
        with_distance(with_distance(some, 0.02), unit),
    ):  # fmt: skip
        torch.testing.assert_close(factors(other), want, rtol=3e-5, atol=0)
