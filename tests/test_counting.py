"""The count law: its values, the price, and that corrections alone bring the counts to it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from clod_adapter.attenuation import attenuate, count_slope, extinction_scale
from clod_adapter.config import AdaptConfig
from clod_adapter.counting import EVERY, NODES, SHARE, CountLaw, count_law

CONFIG = AdaptConfig(max_sv=6.0)
ATTENUATION = CONFIG.attenuation(1.0)
N = 2000


def some(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Opacity logits, log sigma_d and normalised distances."""
    generator = torch.Generator().manual_seed(seed)
    logits, log_sigma, d = (torch.randn(N, generator=generator) for _ in range(3))
    return 2 * logits + 1, log_sigma * 0.8, (0.3 * d).exp()


def test_the_law() -> None:
    for share, exponent in ((0.62, 1.5), (0.8, 1.0), (1.0, 2.0)):
        assert count_law(1.0, share, exponent) == pytest.approx(share)
        values = [count_law(s, share, exponent) for s in np.linspace(1, 20, 200)]
        assert all(b < a for a, b in zip(values, values[1:], strict=False))
        assert count_law(1e4, share, exponent) == pytest.approx(1e4**-exponent, rel=1e-4)
    assert count_law(3.0, 1.0, 1.5) == pytest.approx(3**-1.5)  # with a share of 1 the paper's target throughout
    assert count_law(2.0, 0.62, 1.5) / 2**-1.5 == pytest.approx(0.93, abs=0.005)
    assert count_law(3.0, 0.62, 1.5) / 3**-1.5 == pytest.approx(0.98, abs=0.005)


def test_the_price() -> None:
    logits, log_sigma, d = some()
    law = CountLaw(CONFIG, ATTENUATION, d)
    for s in (1.0, 2.5, 6.0):
        dialled = attenuate(logits, log_sigma.exp(), d, s, ATTENUATION)
        slope = count_slope(logits, dialled.log_opacities, s, ATTENUATION.tau, CONFIG.temperature)
        want = CONFIG.reg_weight / count_law(s, CONFIG.start_share, CONFIG.exponent) * slope
        got = law.gradient(dialled, logits, s)
        torch.testing.assert_close(got, want)
        assert (got >= 0).all() and got.max() > 0


def test_it_takes_note_of_the_counts() -> None:
    logits, log_sigma, d = some()
    law, dials = CountLaw(CONFIG, ATTENUATION, d), np.exp(np.linspace(0, math.log(6), NODES))
    found = [attenuate(logits, log_sigma.exp(), d, float(s), ATTENUATION) for s in dials]
    for _ in range(100):
        for s, dialled in zip(dials, found, strict=True):
            law.gradient(dialled, logits, float(s))
    shares = [float(dialled.keep.float().mean()) for dialled in found]
    excess = [math.log(eta / count_law(s, CONFIG.start_share, CONFIG.exponent)) for eta, s in zip(shares, dials)]  # noqa: B905
    assert law.excess == pytest.approx(excess, abs=1e-3)


def test_twice_too_many_everywhere() -> None:
    logits, log_sigma, d = some()
    law = CountLaw(CONFIG, ATTENUATION, d)
    for turn in range(2):
        law.excess = np.full(NODES, math.log(2))
        for _ in range(EVERY - 1):
            assert law.correction(logits, log_sigma.exp()) is None
        shift = law.correction(logits, log_sigma.exp())
        assert shift is not None and shift.dtype == log_sigma.dtype, turn
        torch.testing.assert_close(shift, torch.full((N,), -SHARE * math.log(2) / CONFIG.exponent))
        assert law.excess == pytest.approx((1 - SHARE) * math.log(2))  # what is still to be mended


def test_among_equals_nobody_overtakes_anybody() -> None:
    """Of one opacity: the fainter of two that leave together has its extinction scale moved less."""
    logits, log_sigma, d = some()
    logits = torch.full_like(logits, 2.0)
    law = CountLaw(CONFIG, ATTENUATION, d)
    law.excess, law.steps = np.linspace(math.log(2), -math.log(2), NODES), EVERY - 1
    before = extinction_scale(logits, log_sigma.exp(), d, ATTENUATION)
    shift = law.correction(logits, log_sigma.exp())
    assert shift is not None and shift.min() < -0.1 and shift.max() > 0.1
    after = extinction_scale(logits, (log_sigma + shift).exp(), d, ATTENUATION)
    assert (after[before.argsort()].diff() >= -1e-5 * after.sort().values[1:]).all()


@pytest.mark.parametrize("start", [-1.0, 1.5])
def test_without_any_picture_the_counts_come_to_the_law(start: float) -> None:
    """From far too few, and from far too many."""
    logits, log_sigma, d = some()
    # Opaque enough that the law can be met: what is fainter than tau s stays nowhere.
    logits, log_sigma = logits.clamp(min=-1.5) + 1, log_sigma + start
    law, random = CountLaw(CONFIG, ATTENUATION, d), np.random.default_rng(0)

    def worst() -> float:
        """Largest departure of the shares kept from the law, as a logarithm, at dial values between the nodes too."""
        found = []
        for s in (1.0, 1.4, 2.0, 3.1, 4.5, 6.0):
            eta = float(attenuate(logits, log_sigma.exp(), d, s, ATTENUATION).keep.float().mean())
            found.append(abs(math.log(eta / count_law(s, CONFIG.start_share, CONFIG.exponent))))
        return max(found)

    assert worst() > 0.5
    for _ in range(1500):
        for s in (1.0, 6.0 ** random.random()):
            law.gradient(attenuate(logits, log_sigma.exp(), d, s, ATTENUATION), logits, s)
        shift = law.correction(logits, log_sigma.exp())
        log_sigma = log_sigma if shift is None else log_sigma + shift
    assert worst() < 0.05
