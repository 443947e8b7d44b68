"""Budgets: solved dial values keep the counts asked for, and interpolate known curves."""

import math
from collections.abc import Sequence

import pytest
import torch
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from clod_adapter import AttenuationConfig, Camera, ClodError, Gaussians, dial_for, with_dial
from clod_adapter.calibration import Calibration, CalibrationRow
from clod_adapter.equation.attenuation import dial
from scenes import gaussians, ring

MAX_SV = 6.0


def adapted(n: int, seed: int, normalizer: str = "scene") -> Gaussians:
    """Gaussians that are culled at dial values within, below and above the range."""
    generator = torch.Generator().manual_seed(seed)
    sigma = (torch.randn(n, generator=generator) * 0.8 + 0.4).exp()
    attenuation = AttenuationConfig(max_sv=MAX_SV, normalizer=normalizer, scene_distance=5.0)
    return with_dial(gaussians(n, 0, seed), sigma, attenuation)


def kept(some: Gaussians, cameras: Sequence[Camera], s: float) -> int:
    return sum(int(dial(some, camera, s).keep.sum()) for camera in cameras)


@settings(deadline=None, max_examples=30)
@example(n=2, seed=2, views=5, share=0.25, normalizer="max")  # one Gaussian is at distance 1 in three views
@given(
    n=st.integers(2, 3000), seed=st.integers(0, 10**6), views=st.integers(1, 5), share=st.floats(0, 1),
    normalizer=st.sampled_from(["scene", "max"]),
)  # fmt: skip
def test_counts_are_exact_up_to_ties(n: int, seed: int, views: int, share: float, normalizer: str) -> None:
    some, cameras = adapted(n, seed, normalizer), ring(views, 48, 36)
    most, fewest = kept(some, cameras, 1.0), kept(some, cameras, MAX_SV)
    wanted = fewest + round(share * (most - fewest))
    assume(wanted > 0)
    solved = dial_for(some, keep=wanted / views, cameras=cameras)
    found = kept(some, cameras, solved.virtual_scale)
    assert 1 <= solved.virtual_scale <= MAX_SV and solved.note == ""
    # At most what was asked for; and where it is less, more would stay at the next smaller dial value in float32.
    assert found <= wanted, (seed, found, wanted)
    assert found == wanted or kept(some, cameras, solved.virtual_scale * (1 - 1e-6)) > wanted, (seed, found, wanted)
    # The Gaussian whose distance is the unit is at distance 1, and its s* is the same in each view where it is that.
    ties = 0 if normalizer == "scene" else views - 1
    assert wanted - found <= max(1, 0.001 * wanted) + ties, (seed, found, wanted)


def table(psnr: Sequence[float], times: Sequence[float] = ()) -> Calibration:
    dials = [2.0**k for k in range(len(psnr))]
    times = times or [10.0 / s for s in dials]
    rows = tuple(CalibrationRow(s, 100 / s, p, 0.9, t) for s, p, t in zip(dials, psnr, times, strict=True))
    return Calibration(rows, 100, 2, 64, 48, "a machine")


def test_a_psnr_drop_is_linear_in_log_s() -> None:
    """From s = 1, not from the best; where it is first spent; a larger one than any is the largest dial value."""
    for psnr, drop, wanted in (
        ([30, 29, 28], 1, 2),
        ([30, 29, 28], 1.25, 2 * 2**0.25),
        ([30, 30.5, 29.5], 0.25, 2 * 2**0.75),
        ([30, 28, 29.5, 27], 1, math.sqrt(2)),
        ([30, 29, 28.25], 3, 4),
    ):
        solved = dial_for(adapted(3, 0), psnr_drop=drop, calibration=table(psnr))
        assert solved.virtual_scale == pytest.approx(wanted, rel=1e-12)
        assert drop < 3 or solved.note.startswith("only 1.75 dB are lost at s = 4")


def test_a_frame_rate_is_reached_for_good() -> None:
    for times, fps, wanted in (
        ([20, 10, 5], 1000 / 15, math.sqrt(2)),
        ([20, 10, 12, 5], 1000 / 11, 4 * 2 ** (1 / 7)),  # not in passing
        ([20, 10, 5], 200, 4),
        ([20, 10, 5], 30, 1),  # s = 1 is fast enough
    ):
        calibration = table([30] * len(times), times)
        solved = dial_for(adapted(3, 0), fps=fps, calibration=calibration)
        assert solved.virtual_scale == pytest.approx(wanted, rel=1e-12)
        assert solved.note == ("s = 1 draws 50 frames a second already" if fps == 30 else "")
        with pytest.raises(ClodError, match="at s = [48], .* takes 5.0 ms, 200 a second"):
            dial_for(adapted(3, 0), fps=201, calibration=calibration)


def test_bad_arguments_are_refused() -> None:
    some, camera = adapted(5, 0), ring(1, 48, 36)
    refused: tuple[tuple[dict[str, float], str], ...] = (
        ({}, "exactly one of keep, psnr_drop and fps"),
        ({"keep": 3, "fps": 3}, "exactly one of keep, psnr_drop and fps"),
        ({"keep": 0}, "keep is 0, it must be positive and finite"),
        ({"fps": math.nan}, "fps is nan"),
        ({"psnr_drop": math.inf}, "psnr_drop is inf"),
        ({"psnr_drop": 1}, "needs the calibration"),
    )
    for budgets, message in refused:
        with pytest.raises(ClodError, match=message):
            dial_for(some, cameras=camera, **budgets)
    for name, message in (("keep", "no camera"), ("fps", "a calibration or cam")):
        with pytest.raises(ClodError, match=message):
            dial_for(some, **{name: 1})
    with pytest.raises(ClodError, match="no sigma_d"):
        dial_for(gaussians(3, 0, 0), keep=1, cameras=camera)
