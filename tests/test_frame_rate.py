"""The control law on simulated renderers: a fixed part plus a power of the dial value, with noise and outliers."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import pytest

from clod_adapter.frame_rate import next_dial

BUDGET = 10.0  # ms
MAX_SV = 7.0
EXPONENTS = (0.2, 0.75, 1.5)
FIXED = (0.0, 0.5)  # of the time at the start
BEFORE, AFTER = 25, 100  # frames before and after a change of the load


@dataclass(frozen=True)
class Renderer:
    """``ms(s) = load BUDGET (fixed + (1 - fixed) (s / start)^-exponent)``, which is the budget at ``start``."""

    exponent: float
    fixed: float
    start: float

    def ms(self, dial: float, load: float = 1.0) -> float:
        return load * BUDGET * (self.fixed + (1 - self.fixed) * (dial / self.start) ** -self.exponent)

    def best(self, load: float) -> float:
        """The dial value in [1, MAX_SV] whose time is the budget, or the nearest to it."""
        rest = (1 / load - self.fixed) / (1 - self.fixed)
        wanted = self.start * rest ** (-1 / self.exponent) if rest > 0 else math.inf
        return min(max(wanted, 1.0), MAX_SV)

    def off(self, dial: float, load: float) -> float:
        """Distance of the noiseless log time from the best in range."""
        return abs(math.log(self.ms(dial, load) / self.ms(self.best(load), load)))

    def follow(self, loads: list[float], measured: Callable[[int], float]) -> list[float]:
        """Dial values of frames with these loads, whose times are multiplied by ``measured``."""
        frames, dial = list[tuple[float, float]](), self.start
        for number, load in enumerate(loads):
            frames.append((dial, self.ms(dial, load) * measured(number)))
            dial = next_dial(frames, BUDGET, MAX_SV)
        dials = [dial for dial, _ in frames]
        assert all(max(a, b) <= 1.1 * min(a, b) * (1 + 1e-9) for a, b in pairwise(dials))
        assert all(1 <= dial <= MAX_SV for dial in dials)
        return dials


@pytest.mark.parametrize("load", [2.0, 4.0, 1 / 3])
@pytest.mark.parametrize("outliers", [False, True])
def test_the_time_is_within_10_percent_after_a_change(load: float, outliers: bool) -> None:
    """After at most 22 frames: 4, and 18 steps of 10 % from one end of the dial to the other.

    It stays there; without outliers, it never turns back.
    """
    for exponent, fixed in product(EXPONENTS, FIXED):
        renderer = Renderer(exponent, fixed, start=2.0 if load > 1 else 5.0)
        loads = [1.0] * BEFORE + [load] * AFTER
        dials = renderer.follow(loads, lambda frame: 5.0 if outliers and frame % 20 == 7 else 1.0)
        settled = dials[BEFORE + 22 :]
        assert all(renderer.off(dial, load) <= 0.1 for dial in settled), (exponent, fixed)
        assert outliers or sorted(settled) in (settled, settled[::-1]), (exponent, fixed)


def test_it_does_not_oscillate_under_noise_of_20_percent() -> None:
    """Over 400 frames of one load: the dial's changes are small, and the time stays near the budget."""
    for exponent, fixed, seed in product(EXPONENTS, FIXED, range(2)):
        renderer, noise = Renderer(exponent, fixed, start=3.0), np.random.default_rng(seed).lognormal(0.0, 0.2, 400)
        dials = np.array(renderer.follow([1.0] * 400, lambda frame, noise=noise: float(noise[frame])))
        times = np.log([renderer.ms(dial) / BUDGET for dial in dials])
        changes = np.abs(np.diff(np.log(dials)))
        assert changes.mean() <= 0.015 and np.median(changes) <= 0.005, (exponent, fixed, seed)
        assert np.log(dials).std() <= 0.2 and times.std() <= 0.1, (exponent, fixed, seed)


def test_the_first_frames_and_single_outliers_do_not_move_it() -> None:
    """A first frame includes compilation; a frame of 0 ms is below a timer's resolution."""
    assert next_dial([(2.0, 900.0)], BUDGET, MAX_SV) == next_dial([(2.0, 900.0)] * 2, BUDGET, MAX_SV) == 2.0
    calm = [(2.0, BUDGET)] * 5
    for time in (900.0, 0.0):
        assert next_dial([*calm, (2.0, time)], BUDGET, MAX_SV) == 2.0
    assert next_dial([*calm, *[(2.0, 0.0)] * 3], BUDGET, MAX_SV) == pytest.approx(2.0 / 1.1)
